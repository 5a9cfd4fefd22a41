"""Decides which clips are fit for a robot that keeps its feet on the floor; every drop has a reason.

Two stages. Before retargeting: PHC's hand-made list for HumanML3D (where it applies) and PHC's older automatic rule (a clip
that starts in the air, or has both feet up for long). After retargeting: gates on the metrics, because the list misses some
sitting clips and cannot know the robot.

Paper: data preparation, "filtered with PHC", 11k clips. PHC's test by tracking in physics is left out here
(`data.tracking` measures a part of it).
Run `python -m proprio_mllm report filter FOLDER` for what was dropped, where and why.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import NDArray

from configs.schema.data import GateConfig
from data.contacts import contact_runs
from data.metrics import Metrics
from data.skeleton import HumanMotion, index

_START_AIR_M: Final = 0.1
_TOES_UP_M: Final = 0.2
_TOES_UP_FRAMES: Final = 30
_LISTED: Final = "PHC list: "
_STARTS: Final = "starts "
_FEET_UP: Final = "both feet above "
_PELVIS: Final = "pelvis below "
#: Metrics with an upper limit in `GateConfig`, in the order in which they are tried.
GATES: Final = (
    "hand_cm",
    "foot_cm",
    "arm_deg",
    "leg_deg",
    "skate_cm_s",
    "penetration_pct",
    "float_pct",
    "saturation_pct",
    "velocity_pct",
    "self_pct",
)


@dataclass(frozen=True, slots=True)
class PhcDecision:
    """PHC's decision about a HumanML3D clip: `truncate` to `frames`, or drop with the issue as the reason."""

    decision: str
    issue: str
    frames: int


@lru_cache(maxsize=1)
def phc_list() -> Mapping[str, PhcDecision]:
    """Decisions by HumanML3D id; clips that are kept whole are not listed."""
    text = (resources.files("data") / "assets" / "phc_filter.csv").read_text(encoding="utf-8")
    return {
        row["id"]: PhcDecision(row["decision"], row["issue"], int(row["frames"] or 0))
        for row in csv.DictReader(text.splitlines())
    }


def apply_phc_list(clip: HumanMotion) -> HumanMotion | str:
    """The clip, its beginning where PHC truncates it, or the reason why it is dropped; mirrored ids share the decision."""
    decision = phc_list().get(clip.name.removeprefix("M"))
    if decision is None:
        return clip
    if decision.decision != "truncate":
        return f"{_LISTED}{decision.issue or decision.decision}"
    frames = min(decision.frames, len(clip.joints))
    opening = None if clip.hand_opening is None else clip.hand_opening[:frames]
    end = (frames - 1) / clip.fps
    captions = tuple(caption for caption in clip.captions if caption.start_s < end)
    return HumanMotion(clip.name, clip.joints[:frames], clip.fps, captions, opening, clip.split)


def automatic_rule(clip: HumanMotion) -> str:
    """PHC's automatic rule on joints: reason to drop the clip, or an empty string."""
    lowest = float(clip.joints[0, :, 2].min())
    if lowest > _START_AIR_M:
        return f"{_STARTS}{lowest:.2f} m above the floor"
    toes = clip.joints[:, [index("left_foot"), index("right_foot")], 2]
    up = toes.min(axis=1) > _TOES_UP_M
    longest = max((end - start for start, end in contact_runs(up)), default=0)
    if longest > _TOES_UP_FRAMES:
        return f"{_FEET_UP}{_TOES_UP_M} m for {longest} frames"
    return ""


def admit(clip: HumanMotion, use_list: bool) -> HumanMotion | str:
    """What of a clip is retargeted, or the reason why none of it is: PHC's list, where it applies, then the automatic rule."""
    kept = apply_phc_list(clip) if use_list else clip
    return kept if isinstance(kept, str) else automatic_rule(kept) or kept


def reason_group(robot: str, reason: str) -> str:
    """What dropped a clip: `PHC list: ISSUE`, `automatic rule`, `unusable`, or the name of a gate.

    Args:
        robot: of a clip dropped after retargeting, else empty.
        reason: of `admit`, of `gate`, or of a clip that could not be loaded.
    """
    if robot:
        return "low_pelvis" if reason.startswith(_PELVIS) else reason.split()[0]
    if reason.startswith(_LISTED):
        return reason
    return "automatic rule" if reason.startswith((_STARTS, _FEET_UP)) else "unusable"


def gate(metrics: Metrics, pelvis_height_m: NDArray[np.float64], standing_m: float, fps: float, limits: GateConfig) -> str:
    """Reason to drop a retargeted clip, or an empty string.

    Args:
        metrics: of the clip.
        pelvis_height_m: (T,) of the robot.
        standing_m: standing pelvis height of the robot.
        fps: frames per second.
        limits: what is allowed.
    """
    for name in GATES:
        value, limit = getattr(metrics, name), getattr(limits, name)
        if not value <= limit:
            return f"{name} {value:.2f} over {limit:g}"
    is_low = np.asarray(pelvis_height_m < limits.low_pelvis * standing_m, dtype=np.bool_)
    low = max((end - start for start, end in contact_runs(is_low)), default=0)
    if low > limits.low_pelvis_s * fps:
        return f"{_PELVIS}{limits.low_pelvis:g} of standing for {low / fps:.1f} s"
    return ""
