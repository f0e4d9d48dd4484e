"""What a mechanism is like: kinematics, small motions, rank of its constraints, growth of small changes."""

from lgsens.analysis._growth import (
    Growth as Growth,
    sensitivity_growth as sensitivity_growth,
)
from lgsens.analysis._kinematics import Kinematics as Kinematics, kinematics as kinematics
from lgsens.analysis._linearize import (
    Linearization as Linearization,
    ModeShape as ModeShape,
    linearize as linearize,
)
from lgsens.analysis._random_road import random_road as random_road
from lgsens.analysis._rank import ConstraintRank as ConstraintRank, constraint_rank as constraint_rank
from lgsens.analysis._statics import Statics as Statics, statics as statics
from lgsens.analysis._step_jacobians import (
    Chart as Chart,
    StepJacobians as StepJacobians,
    step_jacobians as step_jacobians,
)
from lgsens.analysis._weighting import FrequencyWeighting as FrequencyWeighting
