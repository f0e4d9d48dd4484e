"""Rigid bodies, joints and forces: one implementation of the abstract system (paper, §3 and §9)."""

from lgsens.model._beam_load import SectionState as SectionState
from lgsens.model._beam_sections import BeamSection as BeamSection
from lgsens.model._beams import Beam as Beam, BeamElement as BeamElement
from lgsens.model._bent_beam import BentBeam as BentBeam, upward as upward
from lgsens.model._body import RigidBody as RigidBody, lumped as lumped
from lgsens.model._bushing import Bushing as Bushing
from lgsens.model._checks import invalid_numbers as invalid_numbers
from lgsens.model._constraints import (
    AbstractClosedFormConstraint as AbstractClosedFormConstraint,
    AbstractConstraint as AbstractConstraint,
    AbstractRows as AbstractRows,
    AbstractVelocityConstraint as AbstractVelocityConstraint,
    Coincidence as Coincidence,
    ConstraintSum as ConstraintSum,
    Distance as Distance,
    InPlane as InPlane,
    Orthogonality as Orthogonality,
)
from lgsens.model._contacts import TyreLoad as TyreLoad
from lgsens.model._controls import (
    Actuator as Actuator,
    ControlSignals as ControlSignals,
    MaxwellElement as MaxwellElement,
    PIDController as PIDController,
)
from lgsens.model._coordinates import (
    CoordinateForce as CoordinateForce,
    CoordinateMeasure as CoordinateMeasure,
)
from lgsens.model._coupling import CoordinateCoupling as CoordinateCoupling
from lgsens.model._curves import CurveSpringDamper as CurveSpringDamper
from lgsens.model._drivers import (
    Angle as Angle,
    RotationDriver as RotationDriver,
    TranslationDriver as TranslationDriver,
)
from lgsens.model._elements import AbstractElement as AbstractElement, body_fixed as body_fixed
from lgsens.model._flexible import Rigid as Rigid
from lgsens.model._forces import (
    AbstractForce as AbstractForce,
    AppliedForce as AppliedForce,
    Attached as Attached,
    Gravity as Gravity,
    SpringDamper as SpringDamper,
    TyreSpring as TyreSpring,
)
from lgsens.model._frames import Frame as Frame, motion_at as motion_at, moved as moved
from lgsens.model._free import ALL_FREE as ALL_FREE
from lgsens.model._friction import (
    JointFriction as JointFriction,
    LuGreFriction as LuGreFriction,
    SlidingFriction as SlidingFriction,
)
from lgsens.model._joint_forces import joint_wrenches as joint_wrenches
from lgsens.model._joints import (
    AbstractJoint as AbstractJoint,
    DistanceJoint as DistanceJoint,
    FixedJoint as FixedJoint,
    RevoluteJoint as RevoluteJoint,
    SphericalJoint as SphericalJoint,
    UniversalJoint as UniversalJoint,
)
from lgsens.model._linked_bar import LinkedAntiRollBar as LinkedAntiRollBar
from lgsens.model._loads import (
    AbstractClosedFormLoad as AbstractClosedFormLoad,
    AbstractDynamicLoad as AbstractDynamicLoad,
    AbstractLoad as AbstractLoad,
    BushingLoad as BushingLoad,
    LineForce as LineForce,
    LoadTangents as LoadTangents,
    SpringDamperLoad as SpringDamperLoad,
)
from lgsens.model._measured import (
    element_forces as element_forces,
    measured as measured,
    stresses as stresses,
)
from lgsens.model._model import Model as Model
from lgsens.model._on_merged_bodies import carried as carried
from lgsens.model._reductions import (
    AbstractReduction as AbstractReduction,
    Fixed as Fixed,
    Frozen as Frozen,
    Joint as Joint,
    Merged as Merged,
    Rod as Rod,
    Without as Without,
)
from lgsens.model._relative import (
    Coordinate as Coordinate,
    continued as continued,
    relative_motion as relative_motion,
)
from lgsens.model._repeated_rows import driven_equations as driven_equations
from lgsens.model._roads import (
    ISO_8608 as ISO_8608,
    BumpRoad as BumpRoad,
    FlatRoad as FlatRoad,
    SampledRoad as SampledRoad,
    rate_intensity as rate_intensity,
    road_roughness as road_roughness,
)
from lgsens.model._rolling import Rolling as Rolling
from lgsens.model._sampled import Sampled as Sampled
from lgsens.model._screws import RackAndPinionJoint as RackAndPinionJoint, ScrewJoint as ScrewJoint
from lgsens.model._se3_system import SE3System as SE3System, scene_of as scene_of
from lgsens.model._shafts import ConstantVelocityJoint as ConstantVelocityJoint, GearJoint as GearJoint
from lgsens.model._signals import (
    AbstractSignal as AbstractSignal,
    Constant as Constant,
    Delayed as Delayed,
    Harmonic as Harmonic,
    Polynomial as Polynomial,
    Ramp as Ramp,
)
from lgsens.model._sliders import (
    CylindricalJoint as CylindricalJoint,
    PointOnLineJoint as PointOnLineJoint,
    PrismaticJoint as PrismaticJoint,
)
from lgsens.model._stack import (
    constraint_force as constraint_force,
    constraint_jacobian as constraint_jacobian,
    constraint_stiffness as constraint_stiffness,
    load_tangents as load_tangents,
)
from lgsens.model._summary import Summary as Summary
from lgsens.model._surface_joints import (
    PlanarJoint as PlanarJoint,
    PointOnPlaneJoint as PointOnPlaneJoint,
)
from lgsens.model._system import MultibodySystem as MultibodySystem
from lgsens.model._trim import static_preload as static_preload
from lgsens.model._turning_loads import HingeMoment as HingeMoment
from lgsens.model._vehicle_forces import (
    AntiRollBar as AntiRollBar,
    BumpStop as BumpStop,
    Drag as Drag,
    PlaneContact as PlaneContact,
    RotationalSpringDamper as RotationalSpringDamper,
    TorsionSpringDamper as TorsionSpringDamper,
)
