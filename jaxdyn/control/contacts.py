"""Tasks in contact coordinates, for the tip of an arm that slides or rolls on a surface."""

import equinox as eqx
import jax
from jaxtyping import Array, Float

from jaxdyn.contact.surfaces import Surface, check_surface
from jaxdyn.contact.touching import contact_coordinates
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Numbers, pose_leaf
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.system import velocity_to_rate


class ContactCoordinates(eqx.Module):
    r"""Contact coordinates of a fingertip on an object at rest, as tasks of `HybridForce`.

    As a function of q it is eta = (u_o, v_o, u_f, v_f, psi) (5,): the task of a tip that slides, five coordinates of the
    motion free in a frictionless contact. `rolling` is $\dot\alpha_f$ (2,), the rates of (u_f, v_f): the task of
    velocities of a tip that rolls without spin. The laws are then, with the rows $J_F$ of Montana's equations
    (`jd.contact.montana`) and M, C, N of the arm in the twist of the tip,

    $$F_m = M J_F (\ddot\eta_d - K_d \dot e - K_p e) + (M \dot J_F + C J_F) \dot\eta + N + A^T (-\lambda_d + K_I z), \quad
    \tau = J^T F_m,$$

    and the same with $J_f \dot\alpha_f$ in place of $J_F \dot\eta$ for a tip that rolls.

    **Arguments:** `model`: a `Model`; `frame`: the tip's, a body or frame; `object`, `finger`: surfaces
    (`jd.contact.Sphere` ...) of the object and of the tip, each in its frame; `pose`: of the
    object's frame in the world, (4, 4), (3,), (xyz, rpy) or None.

    **Raises:** ValueError for an invalid model, surface or pose and an unknown frame; (when called) as
    `jd.contact.contact_coordinates`.

    ```python
    task = jd.control.ContactCoordinates(model, "tip", jd.contact.Sphere(0.15, poles="y"), jd.contact.Sphere(0.03), center)
    law = jd.control.HybridForce(scene, task, goal, kp=6.0, kd=5.0, force=[5.0])
    law = jd.control.HybridForce(scene, task.rolling, rates, kp=4.0, of="velocity", force=[5.0, 0.0, 0.0, 0.0])
    ```

    Source: EQUATIONS section 8, errata E21 and E22.
    """

    model: Model
    frame: str = eqx.field(static=True)
    object: Surface
    finger: Surface
    pose: Float[Array, "4 4"]

    def __init__(
        self,
        model: Checked[Model],
        frame: str,
        object: Checked[Surface],
        finger: Checked[Surface],
        pose: Numbers | None = None,
    ):
        if not isinstance(model, Model):
            raise ValueError(f"model is a {type(model).__name__}, which has no named frames; pass a Model")
        # Refuses an unknown frame at construction, and not when the law is traced.
        frame_index(model, frame)
        for surface in (object, finger):
            check_surface(surface)
        self.model, self.frame, self.object, self.finger = model, frame, object, finger
        self.pose = pose_leaf(pose, "ContactCoordinates: pose")

    def __call__(self, q: Float[Array, " nq"]) -> Float[Array, "5"]:
        """Contact coordinates eta (5,), in the units of the charts and rad."""
        # The object is at rest: the pose of the tip in its axes depends on q through the arm alone.
        seen = matmul(se3.inverse(self.pose.astype(q.dtype)), frame_pose(self.model, q, self.frame))
        return contact_coordinates(self.object, self.finger, seen)

    def rolling(self, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, "2"]:
        """Rates (2,) of the contact point on the tip, in the units of its chart per second."""
        # eta = (u_o, v_o, u_f, v_f, psi). One derivative along the motion replaces the Jacobian of all five coordinates.
        return jax.jvp(self, (q,), (velocity_to_rate(self.model, q, v),))[1][2:4]
