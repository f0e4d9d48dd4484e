"""Schemes, grids, and the march through time (paper, §4)."""

from lgsens.integrate._aligned import AlignedSteps as AlignedSteps, undivided as undivided
from lgsens.integrate._alpha import AbstractAlpha as AbstractAlpha
from lgsens.integrate._explicit import IndexReducedODE as IndexReducedODE
from lgsens.integrate._explicit_step import ended as ended
from lgsens.integrate._generalized_alpha import GeneralizedAlpha as GeneralizedAlpha
from lgsens.integrate._given import GivenSteps as GivenSteps
from lgsens.integrate._grid import (
    AbstractGrid as AbstractGrid,
    EqualGrid as EqualGrid,
    Start as Start,
    Steps as Steps,
    renewed as renewed,
)
from lgsens.integrate._index3 import factorize_iteration_matrix as factorize_iteration_matrix
from lgsens.integrate._integrator import AbstractIntegrator as AbstractIntegrator, Laid as Laid
from lgsens.integrate._linearized import (
    AbstractLinearizedStep as AbstractLinearizedStep,
    Node as Node,
    Variation as Variation,
)
from lgsens.integrate._loops import (
    earlier as earlier,
    later as later,
    over_steps as over_steps,
    with_first as with_first,
    with_last as with_last,
)
from lgsens.integrate._march import (
    Mark as Mark,
    Walk as Walk,
    first_mark as first_mark,
    march as march,
    march_on as march_on,
    states_of as states_of,
)
from lgsens.integrate._pieces import (
    MANY as MANY,
    SHORTEST as SHORTEST,
    PieceEnds as PieceEnds,
    moved as moved,
    nearest_ends as nearest_ends,
    piece_lengths as piece_lengths,
)
from lgsens.integrate._radau import RadauIIA as RadauIIA
from lgsens.integrate._scheme import (
    AbstractScheme as AbstractScheme,
    Stages as Stages,
    Stats as Stats,
    rows as rows,
    scheme_of as scheme_of,
)
from lgsens.integrate._singular import singular_steps as singular_steps
from lgsens.integrate._uneven import AdaptiveSteps as AdaptiveSteps, ControlledStats as ControlledStats
from lgsens.integrate._uneven_grid import UnevenGrid as UnevenGrid
