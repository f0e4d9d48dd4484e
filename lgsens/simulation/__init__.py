"""A model in, a trajectory out: `simulate`, how it starts, what it returns, failures as data."""

from lgsens.simulation._body_motion import BodyMotion as BodyMotion, PointMotion as PointMotion
from lgsens.simulation._errors import (
    SimulationError as SimulationError,
    failures_by_callback as failures_by_callback,
    raise_if_failed as raise_if_failed,
    throw_if_failed as throw_if_failed,
)
from lgsens.simulation._extrapolation import Extrapolated as Extrapolated, richardson as richardson
from lgsens.simulation._joint_motion import JointMotion as JointMotion
from lgsens.simulation._reached import Reached as Reached
from lgsens.simulation._richardson import Richardson as Richardson
from lgsens.simulation._settings import (
    check_accuracy as check_accuracy,
    check_integrator as check_integrator,
    check_sensitivity as check_sensitivity,
    interval as interval,
    warn_of_single_precision as warn_of_single_precision,
)
from lgsens.simulation._simulate import (
    cut as cut,
    for_any_number as for_any_number,
    outcome as outcome,
    run as run,
    simulate as simulate,
)
from lgsens.simulation._start import (
    Begin as Begin,
    as_system as as_system,
    begin as begin,
    check_state0 as check_state0,
    equilibrium as equilibrium,
    initial_state as initial_state,
    on_joints as on_joints,
)
from lgsens.simulation._tables import require_one_motion as require_one_motion
from lgsens.simulation._to_accuracy import Compared as Compared, aligned as aligned, to_accuracy as to_accuracy
from lgsens.simulation._trajectory import (
    AbstractMotion as AbstractMotion,
    AbstractRun as AbstractRun,
    Instant as Instant,
    Saved as Saved,
    StateError as StateError,
    Trajectory as Trajectory,
)
