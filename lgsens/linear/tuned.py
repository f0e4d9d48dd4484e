"""Every constant that was tuned to a machine, and how it was measured.

Measured on two cores of 3 GHz in double precision; times are ratios to those without, in one run. On another machine
results are the same but for round-off, and times may have their optimum elsewhere: `benchmarks/chain.py`, `loops.py`,
`sweep.py` and `methods.py` measure them. What XLA is told for results to be right is in `lgsens._xla`.
"""

# Block elimination or a dense LU (`_solvers`). Times in µs, from batches of LAPACK's LU and inverses, of products, and
# of scatters in XLA. What a level costs whatever its size is from the quarter-car (94 unknowns) and a chain of 8 links
# (88): a level and an LU of the rest take 0.79 and 0.83 of a dense LU in a run, 0.68 and 0.67 with the gradient.
SMALLEST_SPARSE = 64  # unknowns; below, an LU takes less time than its dispatch could be shortened
DENSE_SQUARE, DENSE_CUBE = 1e-3, 4e-5  # factors and a solution of n unknowns, by n² and n³
LEVEL, CLUSTER, ENTRY = 8.0, 0.3, 1.5e-3  # of a level, of a cluster in it, of a number in its blocks
FLOPS = 8e3  # in a µs

# Levels in a loop (`_solvers`): the cost that it may add, and how many levels it has. A chain of 512 links compiles in
# 0.73 of the time, with a gradient in 0.8. Beside a limit of 1.06, steps and gradients take 1.15 and 0.91 of the time
# with beams of 256 elements, 0.94 and 1.06 of 512, 1.05 and 0.94 with that chain, in processor time on a noisy machine,
# and beams of 256 have 0.93 of the kernels to compile. Without limit: 1.08 and 1.13, 1.4 and 1.18, 0.89 of the kernels.
# A loop compiles about as long as two levels, and four of 64 links gain little.
LOOP_COST = 1.14
LOOP_LEVELS = 4

# Matrices that are factorized once in a run are dense up to so many unknowns (`dynamics._matrices`): an LU of 0.3 ms is
# less than blocks take to compile.
DENSE_ONCE = 200

# Rows up to which one right-hand side is solved by substitution in a loop of our own instead of LAPACK (`_dense`). XLA
# makes one function of a loop around it, but not of one that calls LAPACK, and then each of its operations is begun by
# itself: the gradient of the quarter-car (37 rows left) takes 0.92 of the time. Not measured beyond.
SUBSTITUTED_ROWS = 64

# Rows up to which an inverse is one loop of our own instead of LAPACK's LU and solution (`_dense`). It takes as long
# (of 37 rows 48 … 78 instead of 63 … 82 µs, of 64 rows 1.4 of the time), but LAPACK's solution of 37 columns takes all
# threads of OpenBLAS, which then wait at full speed and keep the cores from XLA. Unless OPENBLAS_NUM_THREADS is 1,
# value and gradient of the quarter-car take 0.78 of the time (JAX 0.11) and 0.88 (0.10), of the top 0.74 and 0.87,
# batches 1.0 and 0.8; if it is, nothing changes.
ELIMINATED_ROWS = 48

# Numbers in an inverse from which on it is rounded to single precision (`_factors`): a quarter of a megabyte, that of
# 70 links. Steps of chains of 128 and 512 links then take 0.96 and 0.91 of the time; small ones gain only where
# inverses of many runs share the caches of a core: batches of quarter-cars (3769 numbers) take 0.9 of the time,
# those of tops (81) would take 1.05.
ROUNDED_NUMBERS, ROUNDED_NUMBERS_IN_A_BATCH = 2**15, 2**10

# Columns up to which the blocks of a level in a loop are multiplied with vectors by a loop that XLA fuses
# (`_block_factors`): 129 blocks of 6 by 12 take 3.7 instead of 5.8 µs, 8 of 11 by 22 0.6 instead of 0.9, 17 of 12 by 48
# 5.2 instead of 3.8. Steps of 512 links take 0.93 of the time and gradients 0.98, with beams of 256 elements 0.94 and
# 0.96; in levels that are written out steps of 64 links take 1.08.
SUMMED_COLUMNS = 24

# Sums by place are gathered, not scattered, up to so many entries of the table, for each number and whatever their
# count (`_sparse.added`). With a scatter in it XLA does not make one function of an iteration of Newton's method: a
# step of the reduced quarter-car takes 25 instead of 13.5 µs, of the top 10.9 instead of 5.3.
GATHERED_PER_NUMBER, GATHERED_ALWAYS = 8, 64

# Chord iterations cost a tenth of a full one (`integrate._newton`): after so many, or where they contract by less, full
# ones cost no more.
CHORD_ITERATIONS, CHORD_CONTRACTION = 12, 0.3

# Numbers and steps of a block of a sweep (`sensitivity._blocks`): factors of 128 kB, so that those of a batch of
# trajectories stay in a core's cache too. With 2**17, alone as fast, 16 quarter-cars at once took 149 instead of 110 µs
# per step and gradient.
BLOCK_NUMBERS, BLOCK_STEPS = 2**14, 64
COUNTED_BLOCKS = 12  # at least, where the number of steps is not known when the program is compiled

# Blocks of products with L are so many times as long (`sensitivity._linearization`): they keep no factors. The
# derivative of the quarter-car's in reverse mode takes 1.3 times as long in blocks of 4 steps as in those of 16 or in
# one of all 480, which takes 23 MB in place of 5 and compiles 1.4 times as long.
PRODUCT_BLOCKS = 4

# Numbers of all linearized steps of a run that may be kept for several sweeps (`sensitivity._known_run`): 128 MB. Of
# 480 steps of the quarter-car, 25 MB, a sweep then takes 9 in place of 33 ms.
KEPT_NUMBERS = 2**24

# What value and gradient cost in simulations (`criteria.direct_or_adjoint`): the top with four parameters and five
# criteria, by benchmarks/methods.py; the four-bar differs by less than the noise.
TYPICAL_COSTS = {
    "direct_fixed": 2.0,
    "direct_per_parameter": 0.12,
    "adjoint_fixed": 2.1,
    "adjoint_per_criterion": 0.09,
}
FORWARD_VARIABLES = 40  # of `optimize.minimize`: their Jacobian costs little more than a gradient in reverse mode

# The most lanes per device of a sweep (`sweeps._batches`). What they carry around their loops should stay in the caches
# of a core (benchmarks/sweep.py: 256 tops of 2 kB, 24 to 32 quarter-cars of 80 kB are the fastest); elsewhere memory
# decides.
LANE_CACHE = 2 * 2**20  # bytes
LANES, LANES_ELSEWHERE = 256, 8192
FREE_SHARE = 0.5  # of the memory that is free, what a batch may take

# What a step costs whatever the scene, in unknowns (`accuracy.fidelity`): value and gradient of the quarter-car of 93
# unknowns with rods and a heaving chassis, 35 of them, take 0.82 of the time, with a locked wheel too, 24, 0.72
# (least processor times on a busy machine).
RUN_UNKNOWNS = 180

# What `accuracy` times in turns, and how many memory maps its programs may take: Linux gives a process 65,530, and a
# large scene takes thousands.
SETTINGS_TOGETHER, MAPS = 8, 40_000

# Entries from which on an array goes from one program to the next as it is (`criteria._packed`), smaller ones together.
# A gradient of the quarter-car outside of `jit` takes 6.6 instead of 9.5 ms; other limits were not tried.
PASSED_ALONE = 4096


def dense(n: int) -> float:
    """The time [µs] of a dense LU of n unknowns and a solution."""
    return DENSE_SQUARE * n**2 + DENSE_CUBE * n**3


def complement(k: int, m: int) -> float:
    """The time [µs] of accelerations by the complement of m constraints of k coordinates (`dynamics._accelerations`).

    Measured: quarter-car 31, chains of 8, 16, 32, 64 links 24, 48, 180, 660, beams of 16, 64 elements 16, 62; in blocks
    50; 38, 71, 140, 240; 71, 110.
    """
    return 8.0 + 6e-3 * m**2 + 3.5e-4 * k**2


def nullspaces(k: int, m: int) -> float:
    """The time [µs] of the three stages of Radau on the nullspaces of m rows of k columns (`integrate._radau_dense`).

    Measured: quarter-car 650, chains of 8, 16, 32, 64 links 690, 1.9e3, 1.2e4, 8.9e4, beams of 4, 8, 16 elements 760,
    2.3e3, 1.1e4; on blocks 2.1e3; 2.3e3, 5.5e3, 1.1e4, 2.1e4; 610, 1.1e3, 1.7e3.
    """
    free = k - m
    return 250.0 + 0.12 * k**2 + 0.7 * (12 * k**2 * (m + 3 * free) + 144 * free**3) / FLOPS
