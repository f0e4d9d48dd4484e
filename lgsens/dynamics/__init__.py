"""Constrained dynamics on any Lie group (paper, §3)."""

from lgsens.dynamics._accelerations import (
    Inertia as Inertia,
    constrained as constrained,
    equations_of_motion as equations_of_motion,
    factorized_accelerations as factorized_accelerations,
    own_parts as own_parts,
    shared_inertia as shared_inertia,
    solves_in_blocks as solves_in_blocks,
    with_shared as with_shared,
)
from lgsens.dynamics._breaks import (
    AbstractTimeFunction as AbstractTimeFunction,
    Breaking as Breaking,
    breaks_of as breaks_of,
    told_breaks as told_breaks,
)
from lgsens.dynamics._constraints import (
    constraint_acceleration as constraint_acceleration,
    constraint_jerk as constraint_jerk,
    constraint_velocity as constraint_velocity,
    fixed_velocity_rate as fixed_velocity_rate,
    full_jacobian as full_jacobian,
    names_of_all as names_of_all,
    of_position_level as of_position_level,
    prescribed_velocity as prescribed_velocity,
)
from lgsens.dynamics._equilibrium import equilibrium as equilibrium
from lgsens.dynamics._initial import (
    Initial as Initial,
    accelerations as accelerations,
    assemble as assemble,
    consistent_velocity as consistent_velocity,
    given_way as given_way,
    initial_state as initial_state,
    is_redundant as is_redundant,
    jerk as jerk,
    split_velocity as split_velocity,
)
from lgsens.dynamics._kinematics import (
    AbstractDrive as AbstractDrive,
    Positions as Positions,
    forces_of_motion as forces_of_motion,
    positions as positions,
)
from lgsens.dynamics._matrices import (
    ConstrainedMass as ConstrainedMass,
    constraint_jacobian as constraint_jacobian,
    factor_size as factor_size,
    factorized as factorized,
    in_blocks as in_blocks,
    kkt_product as kkt_product,
    kkt_solve as kkt_solve,
    mass_matrix as mass_matrix,
    mass_scale as mass_scale,
    multiplier_jacobian as multiplier_jacobian,
    require_linear as require_linear,
    tangents as tangents,
    times_tangent_operator as times_tangent_operator,
)
from lgsens.dynamics._rank import (
    Rank as Rank,
    jacobians_on_the_way as jacobians_on_the_way,
    of_unit_rows as of_unit_rows,
    rank_near_reference as rank_near_reference,
    redundant_names as redundant_names,
    repeated_rows as repeated_rows,
)
from lgsens.dynamics._redundant import (
    least_norm as least_norm,
    require_independent as require_independent,
    softness as softness,
)
from lgsens.dynamics._results import RESULTS as RESULTS
from lgsens.dynamics._statics import StaticPath as StaticPath, static_path as static_path
from lgsens.dynamics._system import (
    AbstractSparseSystem as AbstractSparseSystem,
    AbstractSystem as AbstractSystem,
    State as State,
    Tangents as Tangents,
    autodiff_constraint_jacobian as autodiff_constraint_jacobian,
    autodiff_tangents as autodiff_tangents,
    finite as finite,
)
from lgsens.dynamics._unseen import (
    Faults as Faults,
    Unseen as Unseen,
    coming_to_half_a_turn as coming_to_half_a_turn,
    jumped as jumped,
    unsteady_rate as unsteady_rate,
)
