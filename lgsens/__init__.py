"""lgsens: differentiable constrained multibody dynamics on Lie groups in JAX.

Bodies in absolute coordinates on a Lie group, joints as hard constraints, the Lie-group generalized-α integrator,
and hand-derived derivatives of the trajectory: the direct differentiation method in forward mode, the adjoint
variable method in reverse mode (Sonneville & Brüls, Sensitivity analysis for multibody systems formulated on a Lie
group, Multibody System Dynamics, 2014). SI units; `jax.config.update("jax_enable_x64", True)` before use.
"""

import importlib

from lgsens._xla import compilation_cache as compilation_cache, set_options
from lgsens.analysis import (
    Chart as Chart,
    ConstraintRank as ConstraintRank,
    FrequencyWeighting as FrequencyWeighting,
    Growth as Growth,
    Kinematics as Kinematics,
    Linearization as Linearization,
    Statics as Statics,
    StepJacobians as StepJacobians,
    constraint_rank as constraint_rank,
    kinematics as kinematics,
    linearize as linearize,
    random_road as random_road,
    sensitivity_growth as sensitivity_growth,
    statics as statics,
    step_jacobians as step_jacobians,
)
from lgsens.criteria import (
    Advice as Advice,
    Certificate as Certificate,
    Costs as Costs,
    Criterion as Criterion,
    FiniteDifferences as FiniteDifferences,
    IndexReduced as IndexReduced,
    Kink as Kink,
    PlacedSteps as PlacedSteps,
    Sensitivities as Sensitivities,
    certify as certify,
    differentiate as differentiate,
    direct_or_adjoint as direct_or_adjoint,
    measure_costs as measure_costs,
    soft_maximum as soft_maximum,
    steps_for as steps_for,
    time_integral as time_integral,
)
from lgsens.dynamics import RESULTS as RESULTS, AbstractSystem as AbstractSystem, State as State
from lgsens.integrate import (
    AdaptiveSteps as AdaptiveSteps,
    AlignedSteps as AlignedSteps,
    GeneralizedAlpha as GeneralizedAlpha,
    GivenSteps as GivenSteps,
    IndexReducedODE as IndexReducedODE,
    RadauIIA as RadauIIA,
)
from lgsens.linear import BlockSparse as BlockSparse, DenseLU as DenseLU
from lgsens.model import (
    AbstractForce as AbstractForce,
    AbstractJoint as AbstractJoint,
    AbstractSignal as AbstractSignal,
    Actuator as Actuator,
    AntiRollBar as AntiRollBar,
    AppliedForce as AppliedForce,
    Beam as Beam,
    BeamElement as BeamElement,
    BeamSection as BeamSection,
    BentBeam as BentBeam,
    BumpRoad as BumpRoad,
    BumpStop as BumpStop,
    Bushing as Bushing,
    Constant as Constant,
    ConstantVelocityJoint as ConstantVelocityJoint,
    CoordinateCoupling as CoordinateCoupling,
    CoordinateForce as CoordinateForce,
    CurveSpringDamper as CurveSpringDamper,
    CylindricalJoint as CylindricalJoint,
    Delayed as Delayed,
    DistanceJoint as DistanceJoint,
    Drag as Drag,
    FixedJoint as FixedJoint,
    FlatRoad as FlatRoad,
    GearJoint as GearJoint,
    Gravity as Gravity,
    Harmonic as Harmonic,
    JointFriction as JointFriction,
    LinkedAntiRollBar as LinkedAntiRollBar,
    LuGreFriction as LuGreFriction,
    MaxwellElement as MaxwellElement,
    Model as Model,
    PIDController as PIDController,
    PlanarJoint as PlanarJoint,
    PlaneContact as PlaneContact,
    PointOnLineJoint as PointOnLineJoint,
    PointOnPlaneJoint as PointOnPlaneJoint,
    Polynomial as Polynomial,
    PrismaticJoint as PrismaticJoint,
    RackAndPinionJoint as RackAndPinionJoint,
    Ramp as Ramp,
    RevoluteJoint as RevoluteJoint,
    RigidBody as RigidBody,
    Rolling as Rolling,
    RotationalSpringDamper as RotationalSpringDamper,
    RotationDriver as RotationDriver,
    Sampled as Sampled,
    SampledRoad as SampledRoad,
    ScrewJoint as ScrewJoint,
    SphericalJoint as SphericalJoint,
    SpringDamper as SpringDamper,
    TorsionSpringDamper as TorsionSpringDamper,
    TranslationDriver as TranslationDriver,
    TyreSpring as TyreSpring,
    UniversalJoint as UniversalJoint,
    static_preload as static_preload,
)
from lgsens.sensitivity import (
    AdjointVariable as AdjointVariable,
    AssociativeScan as AssociativeScan,
    Autodiff as Autodiff,
    ContinuousAdjoint as ContinuousAdjoint,
    ContinuousDirect as ContinuousDirect,
    DirectDifferentiation as DirectDifferentiation,
)
from lgsens.simulation import (
    BodyMotion as BodyMotion,
    Extrapolated as Extrapolated,
    Instant as Instant,
    JointMotion as JointMotion,
    PointMotion as PointMotion,
    Reached as Reached,
    Richardson as Richardson,
    Saved as Saved,
    SimulationError as SimulationError,
    StateError as StateError,
    Trajectory as Trajectory,
    equilibrium as equilibrium,
    failures_by_callback as failures_by_callback,
    initial_state as initial_state,
    raise_if_failed as raise_if_failed,
    richardson as richardson,
    simulate as simulate,
)
from lgsens.sweeps import SweepResult as SweepResult, sweep as sweep

_NAMESPACES = (
    "accuracy",
    "examples",
    "importers",
    "optimize",
    "plotting",
    "rigs",
    "testing",
)  # imported when first used: optax and matplotlib take their time

set_options()


def __getattr__(name: str):
    if name in _NAMESPACES:
        return importlib.import_module(f"lgsens.{name}")
    raise AttributeError(f"module 'lgsens' has no attribute {name!r}")
