"""Public functions at a batch of 512: none calls LAPACK in its program, and all of them end, in a process of their own.

Batched calls of LAPACK within one program of XLA can wait for each other for ever (jax-ml/jax), which 256 samples showed first.
"""

import re
import subprocess
import sys
import warnings

import jax
import pytest

HEAD = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jaxdyn as jd
x = jnp.linspace(0.3, 1.0, 512)

def batch(function, *args):
    jax.block_until_ready(jax.jit(jax.vmap(function))(*args))

scene = jd.scenes.four_bar()
q, v = jd.scenes.four_bar.start()
qs = jnp.broadcast_to(q[None], (512, 3)) + 1e-9 * x[:, None]
arm = jd.robots.ur5()
at = x[:, None] * jnp.linspace(0.5, 1.0, 6)[None]
hand, (qh, vh) = jd.scenes.hand_with_ball(), jd.scenes.hand_with_ball.start()
ts = jnp.linspace(0, 0.05, 3)
"""
FUNCTIONS = {
    "assembly and constraints": """
batch(lambda x: (lambda s: (s.q, s.v, s.residual, s.distance))(jd.assemble(scene, q, hold={"1": x})), x)
batch(lambda q: jd.constraints.projections(scene, q), qs)
batch(lambda q: jd.reduction.tangent_basis(scene, q, dof=1), qs)
batch(lambda q: jd.constraints.second_fundamental_form(scene, q, v), qs)
batch(lambda q: jd.constrained_dynamics(scene, q, v, method="schur").acceleration, qs)
batch(lambda q: jd.constrained_dynamics(scene, q, v, rank_tol=0.5).acceleration, qs)
batch(lambda q: jd.constrained_inverse_dynamics(scene, q, v, jnp.zeros(1), motors=["1"]).torques, qs)
bennett = jd.scenes.bennett()
batch(lambda x: jd.constrained_dynamics(bennett, *jd.scenes.bennett.start()).acceleration * x, x)
""",
    "motions": """
for options in ({"method": "variational", "stepsize": 0.01}, {"method": "reduced"}, {"method": "multipliers"}, {}):
    batch(lambda x: jd.simulate(scene, q, x * v, ts, throw=False, **options).q, x)
batch(lambda x: jax.grad(lambda x: jd.simulate(scene, q, x * v, ts, throw=False, stepsize=0.01).q[-1, 0])(x), x)
stiff = jd.Scene(jd.robots.chain(2), forces=(jd.forces.Drive(jnp.array([0.0, 1e4]), jnp.array([0.1, 1e3]), jnp.zeros(2)),))
batch(lambda x: jd.simulate(stiff, x * jnp.ones(2), jnp.zeros(2), ts, solver=jd.solvers.Rodas5P(), throw=False).q, x)
slides, start = jd.scenes.sliding_block(), jd.scenes.sliding_block.start()
batch(lambda x: jd.simulate(slides, start[0], x * start[1], ts, throw=False).q, x)
""",
    "robots": """
batch(lambda q: jd.dynamics.workspace_dynamics(arm, arm.body_names[-1], q, 0.1 * q), at)
place = jd.frame_pose(arm, jnp.full(6, 0.3), arm.body_names[-1])
batch(lambda q: jd.inverse_kinematics(arm, {arm.body_names[-1]: place}, q, guesses=2, throw=False).q, at)
batch(lambda q: jd.dynamics.torque_regressor(arm, q, q, q), at)
step = jd.stepper(arm, 0.01)
advance = lambda y, u: jnp.concatenate(step((y[:6], y[6:]), u)[:2])
cost = lambda y, u, k: jnp.sum(u**2)
def solve(q):
    start = jnp.concatenate([q, jnp.zeros(6)])
    return jd.control.ilqr(advance, cost, lambda y: jnp.sum(y[:6] ** 2), start, jnp.zeros((3, 6)), iterations=2).us
batch(solve, at)
""",
    "hands, contacts and geometry": """
qb = jnp.broadcast_to(qh, (512, qh.size))
cones = [jd.contact.friction_cone("hard-finger", 0.5)] * 3
batch(lambda q: jd.grasp.grasp_map(hand, q), qb)
G = jd.grasp.grasp_map(hand, qh)
batch(lambda x: jd.contact.optimal_forces(G, x * jnp.arange(6.0), cones).x, x)
batch(lambda x: jd.contact.solve_qp(jnp.eye(3), x * jnp.ones(3), jnp.eye(3), jnp.zeros(3)).x, x)
two = jd.robots.chain(2)
batch(lambda x: jd.geometry.riemann_tensor(two, x * jnp.ones(2)), x)
batch(lambda x: jd.geometry.christoffel_symbols(two, x * jnp.ones(2)), x)
batch(lambda q: jd.reduced_dynamics(scene, q, v[:1], basis=(0,)), qs)
batch(lambda q: jd.reduction.gauge_invariant(scene, q, v, jnp.zeros(3)).acceleration, qs)
batch(lambda x: jd.inertia.to_log_cholesky(x * jd.robots.ur5().inertias[0]), x)
motions = jd.grasp.hand_motions(hand, qh)
batch(lambda q: jd.grasp.manipulability(hand, q, length=0.1, motions=motions), qb)
batch(lambda q: jd.grasp.hand_motions(hand, q, sizes=(6, 0)), qb)
batch(lambda q: jd.grasp.object_dynamics(hand, q, jnp.zeros(6)).acceleration, qb)
batch(lambda q: jd.grasp.internal_force_basis(hand, q), qb)
batch(lambda q: jd.grasp.internal_forces(hand, q, jnp.ones(9)), qb)
batch(lambda q: jd.grasp.forces_for_wrench(hand, q, jnp.ones(6)), qb)
batch(lambda q: jd.grasp.hold(hand, q).torques, qb)
""",
    "laws, poles and starts": """
frame = arm.body_names[-1]
place = lambda t: jd.frame_pose(arm, jnp.full(6, 0.3), frame)
for law in (jd.control.OperationalSpace, jd.control.CartesianStiffness):
    batch(lambda q: law(arm, frame, place, 10.0, 5.0)(q, 0.1 * q, 0.0), at)
batch(lambda q: jd.follow(arm, {frame: jnp.stack([place(0)] * 3)}, q, throw=False).q, at)
batch(lambda q: jd.dynamics.mass_matrix_sqrt(arm, q), at)
batch(lambda x: jd.stiffness(jd.Scene(arm, forces=(jd.forces.JointDamping(x),)), at[0], at[0]).decay, x)
batch(lambda x: jd.scenes.allegro_with_cube.start(size=0.06 * x)[1], 1 + 0 * x)
batch(lambda x: jd.scenes.hand_with_ball.start(position=x * jnp.array([0.01, -0.02, 0.28]))[1], 1 + 0 * x)
batch(lambda x: jd.scenes.coordinated_lifting.start(radius=0.3 * x)[1], 1 + 0 * x)
many = jd.robots.chain(40)
batch(lambda x: jd.forward_dynamics(many, x * jnp.ones(40), jnp.ones(40), jnp.ones(40)), x)
""",
    "derivatives": """
end = lambda options: lambda x: jd.simulate(scene, q, x * v, ts, throw=False, stepsize=0.01, **options).q[-1, 0]
# Forward mode over reverse mode, so that both are in the program.
batch(jax.hessian(lambda q: jd.constrained_dynamics(scene, q, v).acceleration[0]), qs)
batch(jax.hessian(lambda q: jd.constraints.projections(scene, q)[0].sum()), qs)
batch(jax.hessian(lambda x: jd.assemble(scene, q, hold={"1": x}).q[1]), x)
batch(jax.hessian(lambda q: jd.dynamics.workspace_dynamics(arm, arm.body_names[-1], q, q).mass_matrix[0, 0]), at)
for derivative, options in ((jax.jacrev, {}), (jax.jacfwd, {"adjoint": "forward"})):
    batch(derivative(end(options | {"method": "reduced"})), x)
    batch(derivative(end(options | {"solver": jd.solvers.Rodas5P()})), x)
""",
}


@pytest.mark.long
@pytest.mark.parametrize("name", FUNCTIONS)
def test_programs_of_a_batch_call_no_lapack(name):
    def check(function, *args):
        for line in jax.jit(jax.vmap(function)).lower(*args).as_text().splitlines():
            if "@lapack" in line:
                # Eigenvalues of matrices without symmetry: one matrix after the other, so that no call waits for another one.
                assert "@lapack_dgeev_ffi" in line and re.search(r": \(tensor<\d+x\d+xf64>\)", line), line

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        names = {}
        exec(HEAD, names)
        names["batch"] = check
        exec(FUNCTIONS[name], names)


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_batches_of_512_end(name):
    run = subprocess.run(
        [sys.executable, "-c", HEAD + FUNCTIONS[name] + "print('done')"], capture_output=True, text=True, timeout=900
    )
    assert run.stdout.split() == ["done"], run.stderr[-2000:]
