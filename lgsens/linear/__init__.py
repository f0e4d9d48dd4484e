"""Linear algebra of a step: dense, and sparse along the graph of bodies and joints."""

from lgsens.linear._block_factors import BlockFactors as BlockFactors, BlockMatrix as BlockMatrix
from lgsens.linear._dense import LU as LU, Inverse as Inverse
from lgsens.linear._elimination import Elimination as Elimination
from lgsens.linear._factors import Factors as Factors, Matrix as Matrix, many_runs as many_runs
from lgsens.linear._linear_solve import (
    LinearEquations as LinearEquations,
    linear_solve as linear_solve,
    programs_in as programs_in,
)
from lgsens.linear._lost import asked as asked, lost as lost, sound as sound
from lgsens.linear._ordering import Graph as Graph, Joint as Joint
from lgsens.linear._solvers import (
    AbstractLinearSolver as AbstractLinearSolver,
    BlockSparse as BlockSparse,
    DenseLU as DenseLU,
    elimination as elimination,
)
from lgsens.linear._sparse import (
    Blocks as Blocks,
    Pattern as Pattern,
    SparseMatrix as SparseMatrix,
    added as added,
    chosen as chosen,
    diagonal as diagonal,
)
