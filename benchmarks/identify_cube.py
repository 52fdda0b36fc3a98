"""A tossed cube identified from its flight: `python -m benchmarks.identify_cube [tosses_all.npz [tosses]]`.

570 recorded tosses of a cube of 0.1048 m (ContactNets; position and quaternion at 148 Hz, velocities by differences). The parts
in the air are cut into pieces of 12 steps that start from states which are fitted too. Free are gravity, the centre of mass
and the ratios of the inertia; mass and mean moment are held, as flight does not depend on them. Flights of even number are
fitted, others predicted.
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd

HALF = 0.0524  # m
STEP = 1 / 148.0
MASS = 0.37  # kg
MEAN = 8.1e-4  # kg m^2, the published moment
PIECE = 12


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) of unit quaternions (n, 4), w first."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def turns(quaternions: np.ndarray) -> np.ndarray:
    """Rotation vectors (n - 1, 3) from each quaternion to the next, in the axes of the body, rad."""
    (a, u), (b, v) = ((q[:, 0], q[:, 1:]) for q in (quaternions[:-1], quaternions[1:]))
    w = a * b + np.sum(u * v, axis=1)
    vector = (a[:, None] * v - b[:, None] * u - np.cross(u, v)) * np.where(w < 0, -1.0, 1.0)[:, None]
    size = np.linalg.norm(vector, axis=1, keepdims=True)
    return 2 * np.arctan2(size, np.abs(w)[:, None]) * vector / np.where(size > 0, size, 1.0)


def airborne(toss: np.ndarray) -> np.ndarray:
    """Samples of the first flight: the lowest corner is a centimetre or more above the board."""
    lowest = toss[:, 2] - np.abs(matrices(toss[:, 3:7])[:, 2]).sum(axis=1)
    up = lowest * HALF > 0.01
    end = len(up) if up.all() else int(np.argmin(up))
    return toss[:end]


def log_of(toss: np.ndarray) -> jd.identify.Log:
    """Pose and body twist along a flight, m and rad/s; velocities are differences of the poses."""
    quaternions = toss[:, 3:7] / np.linalg.norm(toss[:, 3:7], axis=1, keepdims=True)
    q = np.concatenate([HALF * toss[:, :3], quaternions], axis=1)
    # Of second order at the ends too: one-sided differences are half a sample late there, which takes 2 % from gravity.
    linear = np.einsum("nji,nj->ni", matrices(quaternions), np.gradient(q[:, :3], STEP, axis=0, edge_order=2))
    steps = turns(quaternions) / STEP
    ends = [(3 * steps[i] - steps[j])[None] / 2 for i, j in ((0, 1), (-1, -2))]
    omega = np.concatenate([ends[0], (steps[:-1] + steps[1:]) / 2, ends[1]])
    v = np.concatenate([linear, omega], axis=1)
    return jd.identify.Log(STEP * np.arange(len(q)), q, v, None, np.zeros((len(q), 6)))


def flights(path: Path, tosses: int | None = None, least: int = PIECE + 1) -> list[jd.identify.Log]:
    """Logs of the flights that are long enough, of so many tosses; all by default."""
    arrays = np.load(path)
    cut = [airborne(np.asarray(arrays[f"toss_{i}"])) for i in range(tosses or len(arrays.files))]
    return [log_of(toss) for toss in cut if len(toss) >= least]


def body(center, shape) -> jd.Model:
    """A free body of known mass and mean moment, from its centre of mass and the five numbers (a, b, c, d, e) of its shape: about
    the centre of mass it has the moments J (1 + a), J (1 + b), J (1 - a - b), and J (c, d, e) at (xy, xz, yz)."""
    a, b, c, d, e = shape
    about = MEAN * jnp.stack([1 + a, c, d, c, 1 + b, e, d, e, 1 - a - b]).reshape(3, 3)
    return jd.ModelBuilder("cube").add_body("cube", None, "free", (MASS, center, about)).build()


def tossed(numbers) -> jd.Model:
    """The body of the numbers, in their gravity."""
    return body(numbers["center"], numbers["shape"]).replace(gravity=numbers["gravity"])


def cube(gravity=(0.0, 0.0, -9.0), center=(0.01, 0.0, -0.01), shape=(-0.1, 0.0, 0.05, 0.0, 0.0)):
    """Where the fit starts: no cube, its mass out of the centre, in a gravity that is wrong."""
    numbers = {"gravity": gravity, "center": center, "shape": shape}
    return jd.identify.Construction(tossed, {name: jnp.asarray(x) for name, x in numbers.items()})


def identified(logs, start: jd.identify.Construction, progress: bool = False):
    """The fit of all that flight tells: it depends neither on the mass nor on the size of the inertia."""
    parameters = jd.identify.Parameters(start).free(lambda start: list(start.numbers.values()))
    return jd.identify.fit_parameters(
        start,
        logs,
        parameters,
        jd.identify.Objective(horizon=PIECE, initial="free", substeps=1),
        jd.identify.Solver(tolerance=1e-6),
        jd.identify.Execution(progress=progress),
    )


def ratios(ten: np.ndarray) -> np.ndarray:
    """Principal moments about the centre of mass over their mean."""
    c = ten[1:4] / ten[0]
    about = np.array([[ten[4], ten[5], ten[7]], [ten[5], ten[6], ten[8]], [ten[7], ten[8], ten[9]]])
    moments = np.linalg.eigvalsh(about - ten[0] * (c @ c * np.eye(3) - np.outer(c, c)))
    return moments / moments.mean()


def prediction(model: jd.Model, logs, steps: int = 10) -> tuple[float, float]:
    """Rms error, m and rad, after so many steps from measured states (velocities by differences): of unseen tosses."""
    far = []
    for log in logs:
        if len(log) <= steps + 2:
            continue
        q, v = jnp.asarray(log.q[2]), jnp.asarray(log.v[2])
        far.append((q, v, jnp.asarray(log.q[2 + steps])))
    q, v, end = (jnp.stack(x) for x in zip(*far, strict=True))
    ts = jnp.array([0.0, STEP * steps])
    run = jax.jit(jax.vmap(lambda q, v: jd.simulate(model, q, v, ts, stepsize=jd.Steps(rtol=1e-8, atol=1e-10)).q[-1]))
    gap = jax.vmap(lambda a, b: jd.difference(model, a, b))(run(q, v), end)
    return tuple(float(jnp.sqrt(jnp.mean(jnp.sum(gap[:, part] ** 2, axis=1)))) for part in (slice(0, 3), slice(3, 6)))


def main() -> None:
    """Fit and print."""
    jax.config.update("jax_enable_x64", True)
    own = Path(__file__).resolve().parents[2] / "shared" / "data" / "contactnets_cube" / "tosses_all.npz"
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else own
    logs = flights(path, int(sys.argv[2]) if len(sys.argv) > 2 else None)
    train, test = logs[0::2], logs[1::2]
    start = cube()
    begun = time.perf_counter()
    fit = identified(train, start, progress=True)
    seconds = time.perf_counter() - begun
    begun = time.perf_counter()
    identified(train, start)
    print(
        f"{len(logs)} flights of {PIECE + 1} samples or more; fitted {len(train)}, predicted {len(test)}; "
        f"{jd.RESULTS[fit.result]} after {len(fit.history) - 1} steps in {seconds:.1f} s, once more in "
        f"{time.perf_counter() - begun:.2f} s"
    )
    # Fits of disjoint fifths: a witness that knows nothing of how deviations are computed.
    parts = np.array([identified(train[k::5], start).values for k in range(5)])
    grouped = parts.std(axis=0, ddof=1) / 5**0.5
    for name, *numbers in zip(fit.names, fit.values, fit.deviation, grouped, strict=True):
        print("{:22s} {:9.5f} +- {:.5f}, by fifths {:.5f}".format(name.removeprefix("numbers"), *numbers))
    for label, model in (
        ("start", start),
        ("fitted", fit.system),
        ("cube, 9.81", cube((0, 0, -9.81), (0.0,) * 3, (0.0,) * 5)),
    ):
        position, rotation = prediction(model.scene.system, test)
        print(f"10 steps ahead on unseen tosses, {label}: {1e3 * position:.2f} mm, {np.degrees(rotation):.3f} degrees")


if __name__ == "__main__":
    main()
