"""Which experiment would tell two explanations apart that the recordings at hand do not.

advice(findings) -> one sentence for each finding that has rivals
"""

from diagnosis.report.text import effect_words, place_words

# (effects, what to record): the first row that holds both effects speaks
SEPARATING = [
    (
        {"viscous_damping", "back_emf"},
        "back-drive the joint with the motor disconnected: damping of the joint stays, back-EMF "
        "goes",
    ),
    (
        {"delay", "lag"},
        "drive with a sine of rising frequency: a lag shrinks the response, a delay only shifts it",
    ),
    (
        {"delay", "lag", "time_step"},
        "simulate with a smaller time step: what then disappears was the simulator's own step",
    ),
    (
        {"coulomb_friction", "stribeck_friction"},
        "reverse slowly many times, at a tenth of the usual speed: only Stribeck friction falls "
        "as motion starts",
    ),
    (
        {"coulomb_friction", "dead_zone"},
        "push the joint by hand with the actuator off: friction resists, a dead zone does not",
    ),
    (
        {"coulomb_friction", "backlash"},
        "reverse under a light preload in one direction: backlash goes, friction stays",
    ),
    (
        {
            "coulomb_friction",
            "stribeck_friction",
            "viscous_damping",
            "quadratic_damping",
            "air_drag",
            "back_emf",
        },
        "let it coast from several speeds, slow and fast: the force against speed is flat, "
        "straight or curved",
    ),
    (
        {"quadratic_damping", "air_drag", "wind", "mass"},
        "repeat with a known weight added: drag does not change with mass",
    ),
    (
        {"mass", "gain", "armature", "inertia", "sensor_scale", "payload_change"},
        "attach a known weight, or measure the actuator's force directly: it fixes the scale that "
        "motion alone leaves open",
    ),
    (
        {"mass", "center_of_mass", "inertia", "link_length", "gravity"},
        "hold still in several poses and note the holding force: statics show mass times "
        "distance, motion then the inertia",
    ),
    (
        {
            "spring_offset",
            "bias",
            "gravity",
            "external_force",
            "sensor_bias",
            "wind",
            "payload_change",
            "center_of_mass",
        },
        "record the same motion with the mechanism turned on its side or its base tilted, and "
        "once with the actuator off",
    ),
    (
        {
            "stiffness",
            "nonlinear_stiffness",
            "spring_offset",
            "sensor_bias",
            "sensor_scale",
            "cogging",
            "gravity",
        },
        "move slowly through the whole range, both ways: the force against position shows its "
        "shape",
    ),
    (
        {"load_friction", "coulomb_friction", "friction_map", "coupled_friction"},
        "repeat one slow motion through the whole travel, without and with a weight hung on: "
        "friction that follows the load grows with it, a map stays where it is",
    ),
    (
        {"coupled_friction", "coupled_inertia", "armature", "viscous_damping"},
        "hold one of the two joints fast and move the other: what couples them shows at the held "
        "one",
    ),
    (
        {"presliding", "coulomb_friction", "stribeck_friction", "stiffness"},
        "push gently, without breaking loose, and let go: presliding springs back, friction stays "
        "put",
    ),
    (
        {"joint_elasticity", "backlash", "delay", "lag"},
        "hold the link fast and turn the motor a little both ways: elasticity gives in proportion "
        "to the torque, backlash at once and then no more, a delay not at all",
    ),
    (
        {"servo_stiffness", "gain", "stiffness", "spring_offset"},
        "let the servo hold several set points against a known weight, then the joint with it off",
    ),
    (
        {"servo_damping", "viscous_damping", "back_emf", "torque_speed"},
        "back-drive the joint with its drive off, slowly and fast: what is left is the joint's own",
    ),
    (
        {"rate_limit", "lag", "delay", "saturation", "torque_speed"},
        "command steps of several sizes: under a rate limit the rise takes longer for the larger "
        "ones, under a lag all take the same time, a saturation cuts the largest off",
    ),
    (
        {"gain_fade", "gain", "saturation", "payload_change", "viscous_damping"},
        "repeat the same motion after a rest: a drive that faded has recovered",
    ),
    (
        {"friction_map", "cogging", "coulomb_friction"},
        "move slowly through the travel, both ways: cogging keeps its sign, friction turns it",
    ),
    (
        {"saturation", "gain", "dead_zone", "nonlinear_stiffness", "joint_stop"},
        "drive at a small, a medium and a large amplitude",
    ),
    (
        {"contact_friction", "contact_stiffness", "contact_damping", "ground_height", "mass"},
        "record one motion that slides without bouncing, and one that drops straight down",
    ),
    (
        {"sensor_delay", "delay", "lag"},
        "move the part by hand against a second, synchronous sensor: only a sensor's delay remains",
    ),
]
OTHERWISE = "record larger and faster motion, and motion in which only one of the two places moves"


def _way(one, other):
    """The experiment that separates two effects; the same effect at two places needs motion of only
    one."""
    return next(
        (way for both, way in SEPARATING if one != other and {one, other} <= both), OTHERWISE
    )


def advice(findings: list[dict]) -> list[str]:
    """[sentence] for the findings (as in diagnosis.json) that list rivals in `also_possible`."""
    lines = []
    for finding in findings:
        rivals = finding.get("also_possible") or []
        if not rivals:
            continue
        ways = [_way(finding["effect"], rival["effect"]) for rival in rivals]
        names = ", ".join(
            f"{effect_words(r['effect'])} of {place_words(r['place'])}" for r in rivals
        )
        what = f"{effect_words(finding['effect'])} of {place_words(finding['place'])}"
        lines.append(f"{what[:1].upper()}{what[1:]} or {names}: {'; '.join(dict.fromkeys(ways))}.")
    return lines
