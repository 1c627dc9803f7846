"""Hidden forces written by hand: on joints as functions of position, speed and time, and on bodies.

Independent of the catalogue that is to find them; signs and units are the contract's.
"""

import mujoco
import numpy as np

JOINT = (
    "viscous_damping",
    "quadratic_damping",
    "stiffness",
    "nonlinear_stiffness",
    "spring_offset",
    "cogging",
    "joint_stop",
    "periodic_torque",
    "detent",
    "one_way_drag",
)
BODY = ("gravity", "external_force", "payload_change", "air_drag", "wind")


def joint_force(item, stretch, q, v, time, joint):
    """N.m or N that a hidden item adds on its joint.

    stretch: q from the spring's rest, rad or m; v: rad/s or m/s; joint: the model's, for what is
    nominal there already.
    """
    effect, p = item["effect"], item["parameters"]
    nominal = lambda field: float(np.ravel(field)[0])
    if effect == "viscous_damping":
        return -(p["damping"] - nominal(joint.damping)) * v
    if effect == "quadratic_damping":
        return -p["damping2"] * v * abs(v)
    if effect == "stiffness":
        return -(p["stiffness"] - nominal(joint.stiffness)) * stretch
    if effect == "nonlinear_stiffness":
        return -p["stiffness3"] * stretch**3
    if effect == "spring_offset":
        return p["torque"]
    if effect == "cogging":
        return p["amplitude"] * np.sin(p["poles"] * q + p["phase"])
    if effect == "joint_stop":
        over = max(q - p["high"], 0.0) + min(q - p["low"], 0.0)
        push = p["spring"] * over + p["damper"] * v
        return -push if push * over > 0 else 0.0  # a stop never pulls
    if effect == "periodic_torque":
        return p["amplitude"] * np.sin(2 * np.pi * p["hertz"] * time + p["phase"])
    if effect == "detent":  # a well of the given half width, steepest slope = amplitude
        x = (q - p["at"]) / p["width"]
        return -p["amplitude"] * x * np.exp(0.5 - 0.5 * x**2)
    return -p["drag"] * max(v, 0.0) ** 3  # one_way_drag


def body_force(item, model, data, acceleration, event):
    """Adds a hidden item's force to data.xfrc_applied.

    acceleration: qacc (nv,) of the last step; event: whether what comes and goes is there.
    """
    effect, p = item["effect"], item["parameters"]
    if effect == "gravity":
        change = np.array([p[k] for k in "xyz"]) - model.opt.gravity
        data.xfrc_applied[:, :3] += model.body_mass[:, None] * change
    elif effect == "external_force" and (event or not p.get("event")):
        data.xfrc_applied[model.body(item["place"]["name"]).id, :3] += [p[k] for k in "xyz"]
    elif effect == "payload_change" and event:  # a point mass hung at the centre of mass
        body = model.body(item["place"]["name"]).id
        jacobian, rate = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_fwdPosition(model, data)  # after a step these are one step old
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
        mujoco.mj_jacDot(model, data, rate, None, data.xipos[body], body)
        added = p["mass"] - model.body_mass[body]
        data.xfrc_applied[body, :3] += added * (
            model.opt.gravity - jacobian @ acceleration - rate @ data.qvel
        )
    elif effect in ("air_drag", "wind"):
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        wind = np.array([p[k] for k in "xyz"]) if effect == "wind" else model.opt.wind
        density = p["density"] if effect == "air_drag" else model.opt.density
        data.xfrc_applied += drag(model, data, density, wind) - drag(
            model, data, model.opt.density, model.opt.wind
        )


def drag(model, data, density, wind):
    """Air drag on every body's box of equal inertia, as force and torque at its centre (nbody, 6).

    Each face pair of area A meets the air at speed w: force -density A w |w| / 2 along its normal.
    Spin: the same pressure over faces turning through the air, as MuJoCo's inertia-box model has it.
    """
    out = np.zeros((model.nbody, 6))
    velocity = np.empty(6)
    for body in range(1, model.nbody):
        mass, inertia = model.body_mass[body], model.body_inertia[body]
        if mass <= 0:
            continue
        total = inertia.sum()
        box = np.sqrt(np.maximum(6 * (total - 2 * inertia) / mass, 0.0))  # full edge lengths
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        frame = data.ximat[body].reshape(3, 3)
        spin = frame.T @ velocity[:3]
        flow = frame.T @ (velocity[3:] - wind)
        area = np.array([box[1] * box[2], box[0] * box[2], box[0] * box[1]])
        force = -0.5 * density * area * np.abs(flow) * flow
        lever = np.array(
            [
                box[0] * (box[1] ** 4 + box[2] ** 4),
                box[1] * (box[0] ** 4 + box[2] ** 4),
                box[2] * (box[0] ** 4 + box[1] ** 4),
            ]
        )
        torque = -density * lever * np.abs(spin) * spin / 64
        out[body, :3], out[body, 3:] = frame @ force, frame @ torque
    return out
