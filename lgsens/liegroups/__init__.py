"""Matrix Lie groups: exponential, logarithm, tangent operator, and their linear maps (paper, §2).

Everything acts on one unbatched element; `jax.vmap` batches it.
"""

from ._base import AbstractLieGroup as AbstractLieGroup
from ._groups import Pose as Pose, R3xSO3 as R3xSO3, Rn as Rn
from ._poses import Poses as Poses
from ._products import Power as Power, Product as Product
from ._rigid_motions import RigidMotions as RigidMotions
from ._rotation import (
    SO3 as SO3,
    cross as cross,
    nearest_rotation as nearest_rotation,
    skew as skew,
    turn as turn,
    turn_back as turn_back,
    unskew as unskew,
)
from ._screw import SE3 as SE3
