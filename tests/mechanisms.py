"""Models that several tests share: a rail; a Stewart platform and a delta robot, with closed forms of their positions."""

import jax.numpy as jnp
import numpy as np

import jaxdyn as jd


def slider(mass=1.0, axis=(1, 0, 0), gravity=None, **limits):
    """A body on a rail, without gravity unless it is given."""
    builder = jd.ModelBuilder("slider", gravity=gravity)
    builder.add_body("box", joint="prismatic", axis=axis, inertia=(mass, (0, 0, 0), (0, 0, 0)), **limits)
    return builder.build()


def _on_circle(radius, degrees):
    return np.array([radius * np.cos(np.radians(degrees)), radius * np.sin(np.radians(degrees)), 0.0])


def stewart():
    """A Stewart platform, and a guess near its middle position: a plate on six legs with universal, prismatic and ball joints.

    The length of leg i is the distance from `ANCHORS[i]` on the ground to `CORNERS[i]` on the plate.
    """
    builder, loops = jd.ModelBuilder("stewart platform"), []
    builder.add_body("plate", None, "free", (20.0, (0.0, 0.0, 0.0), (2.0, 2.0, 4.0)))
    for i in range(6):
        yoke, sleeve, rod = f"yoke{i}", f"sleeve{i}", f"rod{i}"
        builder.add_body(yoke, None, "revolute", (0.1, (0, 0, 0), (1e-3,) * 3), axis=(1, 0, 0), pose=tuple(ANCHORS[i]))
        builder.add_body(sleeve, yoke, "revolute", (3.0, (0, 0, 0.3), (0.1, 0.1, 0.01)), axis=(0, 1, 0))
        inertia = (1.0, (0.0, 0.0, -0.3), (0.05, 0.05, 0.005))
        builder.add_body(rod, sleeve, "prismatic", inertia, axis=(0, 0, 1), joint_name=f"leg{i}")
        loops.append(jd.loop(rod, None, "plate", tuple(CORNERS[i]), "spherical", name=f"ball{i}"))
    model = builder.build()
    q = np.array(jd.neutral(model))
    place = dict(zip(model.body_names, model.topology.q_slices, strict=True))
    q[place["plate"]][2] = 1.2
    for i in range(6):
        q[place[f"rod{i}"]] = 1.3
    return jd.Scene(model, tuple(loops)), jnp.asarray(q)


ANCHORS = np.array([_on_circle(1.0, 120 * (i // 2) + 10 * (2 * (i % 2) - 1)) for i in range(6)])
CORNERS = np.array([_on_circle(0.6, 120 * (i // 2) + 50 * (2 * (i % 2) - 1)) for i in range(6)])


BASE, UPPER, LOWER, PLATE = 0.2, 0.3, 0.7, 0.08  # m: radius of the hips, upper arms, rods, radius of the ankles


def delta():
    """A delta robot (Clavel 1988), and a guess: three motors at the hips, rods of mass in balls, a platform that only shifts.

    The rods of each parallelogram are one rod in balls at both ends, as their sum is; the platform has three prismatic joints,
    as the parallelograms hold its axes. Hip angles are positive downwards.
    """
    builder, loops = jd.ModelBuilder("delta"), []
    point = (0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    builder.add_body("x_slide", None, "prismatic", point, axis=(1, 0, 0), joint_name="x")
    builder.add_body("y_slide", "x_slide", "prismatic", point, axis=(0, 1, 0), joint_name="y")
    builder.add_body("platform", "y_slide", "prismatic", (1.0, (0, 0, 0), (1e-3,) * 3), axis=(0, 0, 1), joint_name="z")
    for i in range(3):
        turn = np.radians(120 * i)
        hip = (tuple(_on_circle(BASE, 120 * i)), (0.0, 0.0, turn))
        arm = (0.8, (UPPER / 2, 0.0, 0.0), (1e-4, 0.8 * UPPER**2 / 12, 0.8 * UPPER**2 / 12))
        builder.add_body(f"arm{i}", None, "continuous", arm, axis=(0, 1, 0), pose=hip, joint_name=f"hip{i}")
        rod = (0.2, (0.0, 0.0, -LOWER / 2), (0.2 * LOWER**2 / 12, 0.2 * LOWER**2 / 12, 1e-4))
        yoke = (1e-3, (0.0, 0.0, 0.0), (1e-5,) * 3)
        builder.add_body(f"yoke{i}", f"arm{i}", "continuous", yoke, axis=(0, 1, 0), pose=(UPPER, 0.0, 0.0))
        builder.add_body(f"rod{i}", f"yoke{i}", "continuous", rod, axis=(1, 0, 0))
        ankle = tuple(_on_circle(PLATE, 120 * i))
        loops.append(jd.loop(f"rod{i}", (0.0, 0.0, -LOWER), "platform", ankle, "spherical", name=f"ankle{i}"))
    model = builder.build()
    q = np.zeros(model.nq)
    place = dict(zip(model.joint_names, model.topology.q_slices, strict=True))
    q[place["z"]] = -0.7
    for i in range(3):
        q[place[f"hip{i}"]] = 0.3
    return jd.Scene(model, tuple(loops)), jnp.asarray(q)


def delta_hips(point):
    """Hip angles (3,) of a delta robot at a position of its platform: elbows outwards; NaN out of reach."""
    angles = []
    for i in range(3):
        turn = np.radians(-120 * i)
        c, s = np.cos(turn), np.sin(turn)
        x, y, z = jnp.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ point + jnp.array([PLATE - BASE, 0.0, 0.0])
        # |(x - a cos h, y, z + a sin h)| = b:  x cos h - z sin h = (x^2 + y^2 + z^2 + a^2 - b^2) / (2 a).
        right = (x * x + y * y + z * z + UPPER**2 - LOWER**2) / (2 * UPPER)
        size = jnp.sqrt(x * x + z * z)
        angles.append(jnp.arctan2(-z, x) - jnp.arccos(right / size))
    return jnp.stack(angles)


HEIGHT = (LOWER**2 - (BASE + UPPER - PLATE) ** 2) ** 0.5  # m, of the hips over the plate where the upper arms are level


def delta_file():
    """MJCF of the same robot with its parallelograms, arms level: two rods an arm, each on two hinges (21 velocities), and a free
    plate on six balls (18 rows)."""
    arms, loops, lean = "", "", np.degrees(np.arcsin((BASE + UPPER - PLATE) / LOWER))
    for i in range(3):
        rods = ""
        for name, y in ((f"left{i}", 0.05), (f"right{i}", -0.05)):
            rods += (
                f'<body name="{name}" pos="{UPPER} {y} 0" euler="0 {lean} 0"><joint name="swing_{name}" axis="0 1 0"/>'
            )
            rods += f'<joint name="tilt_{name}" axis="1 0 0"/>{_capsule(f"0 0 {-LOWER}")}</body>'
            loops += f'<connect body1="{name}" body2="plate" anchor="0 0 {-LOWER}"/>'
        arms += f'<body euler="0 0 {120 * i}"><body pos="{BASE} 0 0"><joint name="hip{i}" axis="0 1 0"/>'
        arms += f"{_capsule(f'{UPPER} 0 0')}{rods}</body></body>"
    plate = f'<body name="plate" pos="0 0 {-HEIGHT}"><freejoint name="plate"/>{_capsule("0 0 0.01", PLATE)}</body>'
    return f"<mujoco><worldbody>{arms}{plate}</worldbody><equality>{loops}</equality></mujoco>"


def _capsule(end, radius=0.01):
    return f'<geom type="capsule" fromto="0 0 0 {end}" size="{radius}" contype="0" conaffinity="0"/>'
