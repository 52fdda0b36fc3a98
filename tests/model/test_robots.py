"""Robots of example-robot-data, read by `load_model`, against Pinocchio reading the same file."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import ROBOT_FILES, assert_close, load_both, quick, random_states

import jaxdyn as jd

FEW = {"panda.urdf": False}
# ur3.urdf is a xacro file without links, which Pinocchio refuses too; the links of these two have no mass, so that some of
# their joints move no inertia and M is singular.
REFUSED = {"ur3.urdf": "ur3.urdf", "romeo.urdf": "no inertia", "romeo_laas_small.urdf": "no inertia"}


CASES = [
    pytest.param(file, floating, marks=() if FEW.get(file) is floating else pytest.mark.slow, id=f"{file}-{floating}")
    for file in ROBOT_FILES
    if file not in REFUSED
    for floating in (False, True)
]


def ours(model, frames):
    """Every quantity of one state, by the matrix form."""

    def at(q, v, a, tau):
        return {
            "poses": jd.forward_kinematics(model, q),
            "body jacobians": jnp.stack([jd.body_jacobian(model, q, name) for name in frames]),
            "spatial jacobians": jnp.stack([jd.dynamics.spatial_jacobian(model, q, name) for name in frames]),
            "mass matrix": jd.mass_matrix(model, q),
            "C v": jd.coriolis_matrix(model, q, v) @ v,
            "bias": jd.bias_force(model, q, v),
            "gravity": jd.gravity_force(model, q),
            "inverse dynamics": jd.inverse_dynamics(model, q, v, a),
            "forward dynamics": jd.forward_dynamics(model, q, v, tau),
            "center of mass": jd.center_of_mass(model, q),
            "centroidal momentum": jd.dynamics.centroidal_momentum(model, q, v),
            "regressor": jd.dynamics.torque_regressor(model, q, v, a),
        }

    return at


def theirs(source, frames, q, v, a, tau):
    """The same quantities by Pinocchio."""
    data = source.createData()
    ids = [source.getFrameId(name, pin.FrameType.BODY) for name in frames]
    mass = pin.crba(source, data, q)
    mass = np.triu(mass) + np.triu(mass, 1).T
    pin.computeJointJacobians(source, data, q)
    pin.updateFramePlacements(source, data)
    pin.forwardKinematics(source, data, q)
    gravity = pin.computeGeneralizedGravity(source, data, q).copy()
    bias = pin.nonLinearEffects(source, data, q, v).copy()
    return {
        "poses": np.stack([data.oMi[i].homogeneous for i in range(1, source.njoints)]),
        "body jacobians": np.stack([pin.getFrameJacobian(source, data, i, pin.LOCAL) for i in ids]),
        "spatial jacobians": np.stack([pin.getFrameJacobian(source, data, i, pin.WORLD) for i in ids]),
        "mass matrix": mass,
        "C v": bias - gravity,
        "bias": bias,
        "gravity": gravity,
        "inverse dynamics": pin.rnea(source, data, q, v, a).copy(),
        "forward dynamics": pin.aba(source, data, q, v, tau).copy(),
        "center of mass": pin.centerOfMass(source, data, q).copy(),
        "centroidal momentum": pin.computeCentroidalMomentum(source, data, q, v).np.copy(),
        "regressor": pin.computeJointTorqueRegressor(source, data, q, v, a).copy(),
    }


@pytest.mark.long
@pytest.mark.parametrize("file,floating", CASES)
def test_agrees_with_pinocchio(file, floating):
    model, source, bridge = load_both(file, floating)
    if model.nv == 0:
        pytest.skip("no joints: nothing moves")
    links = [name for name in model.frame_names if source.existFrame(name, pin.FrameType.BODY)]
    frames = [links[0], links[len(links) // 2], links[-1]]
    q, v, a, tau, _ = random_states(model, 5, 1)
    got = quick(jax.vmap(ours(model, frames)))(q, v, a, tau)
    for i, q_pin in enumerate(bridge.q_to_pinocchio(q)):
        want = theirs(source, frames, q_pin, *(np.asarray(x[i]) for x in (v, a, tau)))
        mass, spread = want["mass matrix"], np.linalg.cond(want["mass matrix"])
        for key, value in want.items():
            # Solving with M amplifies rounding by its condition number, which reaches 1e7 where fingers hang on humanoids.
            tolerance = 1e-10 if key != "forward dynamics" else max(1e-10, 1e-15 * spread)
            assert_close(got[key][i], value, tolerance, key)
        # Free of that amplification: the acceleration found gives back the force, but for what the last digit of each
        # acceleration is worth, |M| |a| eps. Fingers of 1e-5 kg m^2 on a humanoid accelerate by 1e10 under 1 N m.
        computed = np.asarray(got["forward dynamics"][i])
        missed, worth = mass @ computed + want["bias"] - np.asarray(tau[i]), np.abs(mass) @ np.abs(computed)
        assert np.abs(missed).max() <= 1e-10 * np.abs(tau[i]).max() + 1e-14 * worth.max(), "residual of M a + h = tau"


@pytest.mark.parametrize("file", REFUSED)
def test_refused_robots_say_why(file):
    if file not in ROBOT_FILES:
        pytest.skip(f"{file} is not in this release of example-robot-data")
    with pytest.raises(ValueError, match=REFUSED[file]):
        jd.load_model(ROBOT_FILES[file])
