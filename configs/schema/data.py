"""Frozen configuration of motion data: where clips come from, what is kept, how they are replayed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

_HOLDS: Final = {"humanml3d": "new_joints", "amass": "npz", "folder": "motions"}


@dataclass(frozen=True)
class GateConfig:
    """What a retargeted clip must satisfy; a clip that does not is dropped with the reason.

    Attributes:
        hand_cm: mean distance of the hands to their targets.
        foot_cm: mean distance of the soles to their targets.
        arm_deg, leg_deg: mean angle between robot and human limb segments.
        skate_cm_s: mean speed of planted soles.
        penetration_pct: frames deeper than 1 cm in the floor.
        float_pct: frames in contact with both soles more than 2 cm up.
        saturation_pct: joint-frames at a limit.
        velocity_pct: frames with a joint faster than its limit.
        self_pct: frames in which parts that are no neighbours overlap by more than 1 cm.
        low_pelvis: share of the standing pelvis height that counts as low.
        low_pelvis_s: longest time in which the pelvis may be low.
    """

    hand_cm: float = 3.0
    foot_cm: float = 2.0
    arm_deg: float = 20.0
    leg_deg: float = 25.0
    skate_cm_s: float = 8.0
    penetration_pct: float = 10.0
    float_pct: float = 10.0
    saturation_pct: float = 25.0
    velocity_pct: float = 1.0
    self_pct: float = 10.0
    low_pelvis: float = 0.5
    low_pelvis_s: float = 0.5


@dataclass(frozen=True)
class ReplayConfig:
    """Head-camera pictures of clips, replayed in furnished rooms.

    Attributes:
        enabled: off leaves clips without pictures.
        rooms: rooms in turn.
        pictures_per_s: pictures per second of motion.
        image_size: rows and columns.
        attempts: placements tried per room until the path is free.
    """

    enabled: bool = True
    rooms: tuple[str, ...] = ("kitchen_1", "living_room_1")
    pictures_per_s: float = 1.0
    image_size: int = 112
    attempts: int = 60

    def __post_init__(self) -> None:
        if not self.rooms:
            raise ValueError("rooms must not be empty")
        if not 0.0 < self.pictures_per_s <= 20.0:
            raise ValueError(f"pictures_per_s {self.pictures_per_s} outside (0, 20]")
        if self.image_size < 1 or self.attempts < 1:
            raise ValueError(f"image_size {self.image_size} and attempts {self.attempts} must be positive")


@dataclass(frozen=True)
class DataConfig:
    """Motion data.

    Attributes:
        source: `generated`; `humanml3d` for a folder in HumanML3D's format; `amass` for a folder of AMASS; `folder` for one of
            `.npz` (AMASS), `.pt` (OMOMO) and `.npy` (motion capture) files.
        path: the folder; needed unless clips are generated, None puts those beside the shards.
        body_models: folder of SMPL models, needed for AMASS clips.
        clips: generated clips; else the most clips that are read, 0 for all.
        seed: of the generated clips and of the placements.
        splits: which lists are read.
        mirrored: whether ids with prefix M are read.
        phc_list: whether PHC's list of unsuitable HumanML3D clips applies.
        robots: robots in turn.
        iterations: solver iterations per frame.
        part_size: clips per part file.
        workers: processes; 1 stays in this one.
        scheduler: who runs the workers, `local` processes or `ray`; with `ray` on a cluster, `workers` says how many parts are
            computed at a time.
        ray_address: a running Ray cluster that shares the data set's folder; None starts Ray on this machine for the run.
        gates: what a clip must satisfy.
        replay: pictures.
    """

    source: Literal["generated", "humanml3d", "amass", "folder"] = "generated"
    path: str | None = None
    body_models: str | None = None
    clips: int = 3000
    seed: int = 0
    splits: tuple[str, ...] = ("train", "val", "test")
    mirrored: bool = True
    phc_list: bool = False
    robots: tuple[str, ...] = ("h1", "x1")
    iterations: int = 3
    part_size: int = 24
    workers: int = 2
    scheduler: Literal["local", "ray"] = "local"
    ray_address: str | None = None
    gates: GateConfig = field(default_factory=GateConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)

    def __post_init__(self) -> None:
        if self.source != "generated" and not self.path:
            raise ValueError(f"path is needed: data={self.source} data.path=/folder/with/{_HOLDS[self.source]}")
        if self.source == "amass" and not self.body_models:
            raise ValueError("body_models is needed: data.body_models=/folder/with/smplh")
        if self.clips < 0 or (self.source == "generated" and self.clips == 0):
            raise ValueError(f"clips {self.clips} must be positive")
        if not self.robots:
            raise ValueError("robots must not be empty")
        for name in ("iterations", "part_size", "workers"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} {getattr(self, name)} must be at least 1")
