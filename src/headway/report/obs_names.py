"""What the numbers of each environment's observation are, for axis labels."""

_HOPPER_JOINTS = ("thigh", "leg", "foot")
_CHEETAH_JOINTS = (
    "back thigh",
    "back shin",
    "back foot",
    "front thigh",
    "front shin",
    "front foot",
)
_HUMANOID_JOINTS = (
    "abdomen z", "abdomen y", "abdomen x",
    "right hip x", "right hip z", "right hip y", "right knee",
    "left hip x", "left hip z", "left hip y", "left knee",
    "right shoulder 1", "right shoulder 2", "right elbow",
    "left shoulder 1", "left shoulder 2", "left elbow",
)  # fmt: skip
_ANT_JOINTS = tuple(f"{part} {leg}" for leg in range(1, 5) for part in ("hip", "ankle"))
_LINEAR = ("x velocity (m/s)", "y velocity (m/s)", "z velocity (m/s)")
_ANGULAR = tuple(f"{axis} angular velocity (rad/s)" for axis in "xyz")
_QUATERNION = tuple(f"torso quaternion {part}" for part in "wxyz")
_PITCH, _PITCH_RATE = "torso pitch (rad)", "torso pitch rate (rad/s)"
_PLANAR = ("x velocity (m/s)", "z velocity (m/s)", _PITCH_RATE)


def _angles(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{joint} angle (rad)" for joint in joints)


def _rates(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{joint} rate (rad/s)" for joint in joints)


_NAMES: dict[str, tuple[str, ...]] = {
    "cartpole-swingup": (
        "cart position (m)", "cart velocity (m/s)", "cos θ", "sin θ", "pole rate (rad/s)",
    ),
    "pendulum": ("cos θ", "sin θ", "angular velocity (rad/s)"),
    "hopper": (
        "height (m)", _PITCH, *_angles(_HOPPER_JOINTS), *_PLANAR, *_rates(_HOPPER_JOINTS),
        "average x velocity (m/s)",
    ),
    "slim-humanoid": (
        "height (m)", *_QUATERNION, *_angles(_HUMANOID_JOINTS),
        *_LINEAR, *_ANGULAR, *_rates(_HUMANOID_JOINTS),
    ),
    "half-cheetah": (
        "average x velocity (m/s)", "height (m)", _PITCH, *_angles(_CHEETAH_JOINTS),
        *_PLANAR, *_rates(_CHEETAH_JOINTS),
    ),
    "crippled-ant": (
        "x (m)", "y (m)", "height (m)", *_QUATERNION, *_angles(_ANT_JOINTS),
        *_LINEAR, *_ANGULAR, *_rates(_ANT_JOINTS),
        *(f"torso rotation ({row}, {column})" for row in range(3) for column in range(3)),
        "torso x (m)", "torso y (m)", "torso z (m)",
    ),
}  # fmt: skip


_LAST_IS_OPTIONAL = ("hopper",)


def obs_names(env: str, obs_size: int) -> tuple[str, ...]:
    """Name each number of an observation; plain numbering where the names are not known.

    Args:
        env: Short name of the environment.
        obs_size: Width of its observations, which its options may change.
    """
    names = _NAMES.get(env, ())
    if obs_size == len(names) or (env in _LAST_IS_OPTIONAL and obs_size == len(names) - 1):
        return names[:obs_size]
    return tuple(f"observation[{index}]" for index in range(obs_size))
