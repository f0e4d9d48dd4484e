"""The Lie-group generalized-α integrator (paper, §4)."""

from lgsens.integrate._adaptive import (
    AdaptiveSteps as AdaptiveSteps,
    ControlledStats as ControlledStats,
    FirstState as FirstState,
    integrate_controlled as integrate_controlled,
)
from lgsens.integrate._explicit_steps import (
    Coefficients as Coefficients,
    Numbers as Numbers,
    equal_steps as equal_steps,
    projection as projection,
)
from lgsens.integrate._guess import Guess as Guess
from lgsens.integrate._integrate import (
    Mark as Mark,
    integrate as integrate,
    integrate_onward as integrate_onward,
    integrate_outputs as integrate_outputs,
)
from lgsens.integrate._newton import (
    Chord as Chord,
    Constants as Constants,
    Stats as Stats,
    take_step as take_step,
)
from lgsens.integrate._scheme import (
    GeneralizedAlpha as GeneralizedAlpha,
    Motion as Motion,
    advance as advance,
    factorize_iteration_matrix as factorize_iteration_matrix,
    increment as increment,
    missed_increment as missed_increment,
)
from lgsens.integrate._singular import margin_of as margin_of, singular_steps as singular_steps
from lgsens.integrate._stabilized import (
    StabilizedFactors as StabilizedFactors,
    StabilizedStep as StabilizedStep,
    StabilizedTangents as StabilizedTangents,
    by_configuration as by_configuration,
    halves as halves,
    with_corrections as with_corrections,
    without_corrections as without_corrections,
)
from lgsens.integrate._uneven import integrate_uneven as integrate_uneven, moved as moved
