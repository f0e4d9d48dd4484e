"""How a computation ended: data inside a trace, a message outside it."""

from enum import IntEnum


class RESULTS(IntEnum):
    """Result code of a simulation; `Trajectory.result` holds its value, an int32 array of shape ()."""

    successful = 0
    assembly_failed = 1
    redundant_constraints = 2
    newton_failed = 3
    equilibrium_failed = 4
    integration_failed = 5
    position_failed = 6
    steps_exhausted = 7
    singular_configuration = 8
    turn_not_resolved = 9
    invalid_numbers = 10
    not_steady = 11
    statics_failed = 12
    not_held = 13
    off_joints = 14
    angle_jumped = 15
    joints_apart = 16
    outputs_not_steady = 17

    @property
    def message(self) -> str:
        """What happened and what to try."""
        return _MESSAGES[self]


_MESSAGES = {
    RESULTS.successful: "The computation was successful.",
    RESULTS.assembly_failed: (
        "The mechanism cannot be assembled from its reference configuration: no configuration nearby "
        "satisfies all joints. Check lengths, hardpoints and axes of the joints named, or start closer."
    ),
    RESULTS.redundant_constraints: (
        "The joints constrain the same motion twice, so the multipliers are not unique. Give the bodies of a planar "
        "mechanism free='x y rz', replace one of the joints named by one with fewer equations (a revolute by a "
        "spherical or a cylindrical joint, say; in a plane a cylindrical one by a revolute or a prismatic joint), or "
        "remove it where the `free` coordinates of its bodies satisfy it anyway. Or let Model(…, redundant='remove') "
        "leave out what repeats, or keep it and take the multipliers of least norm, redundant='minimum_norm'; unless "
        "they do so in this configuration only, a singular one: `constraint_rank` tells."
    ),
    RESULTS.newton_failed: (
        "Newton's iteration did not converge. Try a smaller step (more `num_steps`), more "
        "`max_iterations` (or `iterations`) of the integrator, GeneralizedAlpha(stabilized=True) where fast rotations "
        "in joints made velocities grow from step to step, or look for a singular configuration at this time."
    ),
    RESULTS.equilibrium_failed: (
        "No static equilibrium was found near the reference configuration. Start closer to it, or check "
        "that the forces can balance (a body that nothing holds falls). A linkage loaded beyond its dead centre snaps "
        "through: follow it by `simulate` with damping, or by `statics` that drives the displacement."
    ),
    RESULTS.integration_failed: (
        "The explicit integration left the finite numbers, or took more than `max_steps` steps in an output interval. "
        "Try more `num_steps`, a looser `rtol`, more `max_steps`, or, for stiff forces, GeneralizedAlpha."
    ),
    RESULTS.singular_configuration: (
        "The mechanism passes a singular configuration, where its joints lose independence and the motion may branch "
        "(a linkage that lies flat): which way it goes on is not determined, and derivatives by lengths are infinite. "
        "End the simulation before, change the lengths, or let a joint give way (`Bushing`). With redundant='remove' "
        "it may be the equations that are left, not the mechanism: compare 'minimum_norm'."
    ),
    RESULTS.turn_not_resolved: (
        "A body turns by more than π in a step while its angular velocity changes: what loads do in between, the steps "
        "do not see, and the motion may be quite another one. Take steps of 0.3 rad or less (more `num_steps`)."
    ),
    RESULTS.angle_jumped: (
        "An angle passes half a turn, which poses do not tell from the other half, and what depends on it jumped. Let "
        "a spring, or a curve of two turns, count them (`TorsionSpringDamper` or `CoordinateForce` with turns=True), "
        "divide a beam into more elements; give gears and couplings `teeth` of which the ratio makes an integer, or "
        "None where there are none (`GearJoint`); couple an angle to a displacement, not that to the angle, or by a "
        "curve that closes after one turn, as of a cam over the angle of its own shaft (`CoordinateCoupling`)."
    ),
    RESULTS.joints_apart: (
        "Equations of joints that redundant='remove' left out do not hold any more. Others imply them for lengths and "
        "axes that fit, as parallel axes of a planar linkage do, and on one branch of the motion: these numbers do not "
        "fit, or the motion has changed the branch. Keep what has to fit in the parameters of a design, or let a joint "
        "give way (`Bushing`); for a branch take smaller steps, and keep Newton's `tolerance` below 1e-4."
    ),
    RESULTS.position_failed: (
        "No position satisfies the joints for these values of the driven ones: they are out of reach, or the mechanism "
        "passes a dead centre, where the driven values do not determine it, or begins in one, its reference. Ask for "
        "values within reach, drive another coordinate, come there in smaller steps, or begin elsewhere."
    ),
    RESULTS.invalid_numbers: (
        "A number of the scene is not finite, or one that no body has (a mass that is not positive, an inertia whose "
        "moments break the triangle inequality, an orientation far from a rotation) or that its `free` leaves out (a "
        "velocity, the axis of its hinge), or a signal has no finite rate or acceleration (√t at 0), or `t1` is not "
        "later than `t0`. Bound what an optimizer may change; a model that is built outside of `jit` names the element."
    ),
    RESULTS.not_steady: (
        "The motion is not steady: the equations of small motions about it change with time. Linearize at an "
        "equilibrium of all forces (constant ones accelerate a state of rest: an input that is none at rest has "
        "`signal=lg.Constant(0.0)`), or name the `rotation` of axes in which it does not change (a body that turns "
        "about another axis than that of its symmetry has none)."
    ),
    RESULTS.outputs_not_steady: (
        "The motion is steady, but outputs of it change with time: take them in axes in which they do not, not in "
        "those of a body that turns."
    ),
    RESULTS.statics_failed: (
        "No static equilibrium was found for these driven values and loads: they are out of reach, or the equilibrium "
        "becomes unstable on the way (a linkage that snaps through). Ask for less, or come there in smaller steps."
    ),
    RESULTS.not_held: (
        "The equilibrium is not determined: something can move without any force against it. Lock it (a wheel on its "
        "hinge: `FixedJoint`), hold it (`RigidBody.free`), or give it a spring, however weak; or drive it."
    ),
    RESULTS.off_joints: (
        "The given state does not satisfy the joints at t0, by its positions or by its velocities. Give a state of "
        "this model at this time: `initial_state(model, t0=t0)`, `equilibrium(model, t0=t0)`, or the last one of a run "
        "of a model with the same hardpoints."
    ),
    RESULTS.steps_exhausted: (
        "Error control needs more steps than `num_steps` allows. Try more `num_steps` or a looser `tolerance`; "
        "in single precision a tolerance below 1e-4 is below round-off."
    ),
}
