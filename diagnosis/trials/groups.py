"""Names of what a trial may hide, grouped by what each needs and where it can be."""

from diagnosis.trials import laws as L

# Names grouped by what they need; every group's builder is below.
FIELDS = (
    "mass",
    "inertia",
    "center_of_mass",
    "armature",
    "viscous_damping",
    "coulomb_friction",
    "stiffness",
    "gain",
    "bias",
    "servo_stiffness",
    "servo_damping",
    "saturation",
    "gravity",
    "link_length",
    "joint_stop",
    "contact_friction",
    "contact_stiffness",
    "contact_damping",
    "ground_height",
)
REMOVABLE = tuple(name for name in FIELDS if name not in ("saturation", "joint_stop"))
LAWS = (
    "quadratic_damping",
    "stribeck_friction",
    "nonlinear_stiffness",
    "spring_offset",
    "cogging",
    "backlash",
    "delay",
    "lag",
    "dead_zone",
    "back_emf",
    "air_drag",
    "wind",
    "external_force",
    "payload_change",
    "sensor_bias",
    "sensor_scale",
    "sensor_delay",
    "load_friction",
    "friction_map",
    "joint_elasticity",
    "presliding",
    "rate_limit",
    "torque_speed",
    "gain_fade",
    "coupled_friction",
    "coupled_inertia",
)
OF_DRIVES = (
    "gain",
    "bias",
    "servo_stiffness",
    "servo_damping",
    "saturation",
    "delay",
    "lag",
    "dead_zone",
    "back_emf",
    "load_friction",
    "rate_limit",
    "torque_speed",
    "gain_fade",
    "joint_elasticity",
    "backlash",
    "UnevenMotor",
    "SagGain",
    "BrakeDrag",
    "cogging",
)
OF_PAIRS = ("coupled_friction", "coupled_inertia", "NeighbourSpring")
OF_BODIES = (
    "mass",
    "inertia",
    "center_of_mass",
    "external_force",
    "payload_change",
    "link_length",
)
OF_GROUND = {
    "contact_friction": ("sliding", "sliding"),
    "contact_stiffness": ("contact_stiffness", "stiffness"),
    "contact_damping": ("contact_damping", "damping"),
    "ground_height": ("ground_height", "z"),
}
MIMICS = (
    ("coulomb_friction", "viscous_damping"),
    ("viscous_damping", "quadratic_damping"),
    ("delay", "lag"),
    ("joint_elasticity", "delay"),
    ("stiffness", "nonlinear_stiffness"),
    ("spring_offset", "coulomb_friction"),
    ("mass", "armature"),
    ("backlash", "dead_zone"),
    ("saturation", "gain"),
    ("torque_speed", "back_emf"),
    ("sensor_bias", "stiffness"),
)
AIR = 1.2  # kg/m^3
FAMILIES = (  # of which a robot hides one: two would be one law with other values
    ("backlash", "joint_elasticity"),
    ("coulomb_friction", "stribeck_friction", "presliding", "friction_map"),
    ("mass", "inertia"),
    ("wind", "air_drag"),
)
ONE_LAW = (  # of which a joint hides one: the motion shows their sum or product alone
    ("gain", "load_friction"),
    ("delay", "sensor_delay"),
    ("gain", "servo_damping", "servo_stiffness"),
    ("bias", "spring_offset"),
    ("viscous_damping", "back_emf", "servo_damping"),
)
OF_WORLD = ("gravity", "wind", "air_drag")
WRONG_AXIS = "wrong_axis"
UNNAMED = (*(law.__name__ for law in L.UNNAMED), WRONG_AXIS)
