"""`[plant]` of a scenario: how the simulated arm differs from its description. The controller never sees it."""

from typing import Annotated, Literal

from msgspec import Meta

from rtctl.spec.obstacles import Length
from rtctl.spec.robot import Key, Table, Text

Factor = Annotated[float, Meta(ge=-0.9, le=10.0)]
ByLink = Annotated[dict[Key, Factor], Meta(max_length=64)]
Torque = Annotated[float, Meta(ge=0.0, le=1000.0)]
Torques = Annotated[tuple[Torque, ...], Meta(min_length=1, max_length=15)]
Gain = Annotated[float, Meta(ge=0.0, le=2.0)]
Gains = Annotated[tuple[Gain, ...], Meta(min_length=1, max_length=15)]
Slip = Annotated[float, Meta(ge=1e-3, le=1000.0)]
Brake = Literal["none", "ideal"] | Slip
Brakes = Annotated[tuple[Brake, ...], Meta(min_length=1, max_length=15)]
Zero = Annotated[float, Meta(ge=-100.0, le=100.0)]
Zeros = Annotated[tuple[Zero, ...], Meta(min_length=1, max_length=15)]
Direction = Literal[1, -1]
Directions = Annotated[tuple[Direction, ...], Meta(min_length=1, max_length=15)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
CanId = Annotated[int, Meta(ge=0, le=0x7FF)]


class PlantTable(Table, frozen=True, kw_only=True):
    """One value stands for all joints or links where a list or table could give each its own."""

    payload_kg: Annotated[float, Meta(ge=0.0, le=200.0)] = 0.0
    payload_com_m: Annotated[tuple[Length, Length, Length], Meta(description="in the frame of payload_link")] = (
        0.0,
        0.0,
        0.0,
    )
    payload_link: Annotated[Key, Meta(description="the payload is fixed to it; default: the tip's")] | None = None
    mass_error: Annotated[Factor | ByLink, Meta(description="fraction added to a link's mass")] = 0.0
    inertia_error: Annotated[Factor | ByLink, Meta(description="fraction added to a link's inertia tensor")] = 0.0
    urdf_dynamics: Annotated[bool, Meta(description="the damping and friction of the URDF act, too")] = False
    coulomb_Nm: (
        Annotated[
            Torque | Torques, Meta(description="friction of a joint that slides; default: as the robot file says")
        ]
        | None
    ) = None
    static_Nm: Annotated[Torque | Torques, Meta(description="friction of one that sticks; at least coulomb_Nm")] = 0.0
    viscous_Nms_rad: Annotated[Torque | Torques, Meta(description="beside the robot file's")] = 0.0
    torque_gain: Annotated[Gain | Gains, Meta(description="what the joint gets, of what the drive says it gives")] = 1.0
    brake: (
        Annotated[
            Brake | Brakes,
            Meta(description="the Nm at which it slips; default: ideal where the file has any"),
        ]
        | None
    ) = None
    encoder_zero_rad: (
        Annotated[Zero | Zeros, Meta(description="a drive reads direction * q + zero; default: as the robot file says")]
        | None
    ) = None
    encoder_direction: (
        Annotated[
            Direction | Directions, Meta(description="-1: mounted the other way round; default: as the file says")
        ]
        | None
    ) = None
    reply_loss: Annotated[Share, Meta(description="of the drives' replies, that never arrive")] = 0.0
    reply_late: Annotated[Share, Meta(description="of the drives' replies, that arrive a period late")] = 0.0
    talker_ids: Annotated[
        tuple[CanId, ...], Meta(max_length=8, description="on each of them somebody else sends a frame every period")
    ] = ()
    gripper_thing: Annotated[
        float, Meta(ge=0.0, le=2.0, description="share of its way at which a gripper meets a thing; above 1: nothing")
    ] = 2.0
    engine: (
        Annotated[
            Literal["bullet", "mujoco"],
            Meta(description="what moves the arm; default: bullet, mujoco where pybullet is not installed"),
        ]
        | None
    ) = None
    model: (
        Annotated[
            Text,
            Meta(description="MJCF that moves in the place of the URDF: a path beside the robot file, or package://"),
        ]
        | None
    ) = None
