"""This project's retargeter beside a plain mink solver in the manner of GMR and beside holosoma, on the same clips in one run.

    python benchmarks/retarget.py [--mink PYTHON] [--holosoma PYTHON] [--frames N] [--repeats N] [--seed S] [--out FILE]

Aims: at least 4 times faster than the mink solver and 200 times faster than holosoma, at equal or better hand error, foot
error, skate and self-collision. The output says for each whether it was met, and where the others are better.

`--mink` and `--holosoma` are Pythons of environments of their own; without them their columns are left out:

    python3.11 -m venv mink
    mink/bin/pip install mink==1.3.0 mujoco==4.0.0 daqp==0.11.0
    python3.11 -m venv holosoma
    holosoma/bin/pip install --extra-index-url https://download.pytorch.org/whl/cpu torch==2.13.0 mujoco==3.3.7 numpy==2.3.5 \
        cvxpy libigl trimesh smplx tyro yourdfpy robot-descriptions viser scipy jinja2 tqdm matplotlib
    holosoma/bin/pip install --no-deps holosoma-retargeting==0.1.0

Holosoma needs a MuJoCo before 3.12. How the two are set up is told in `retargeters/gmr.py` and `retargeters/holosoma.py`.

* clips: two OMOMO clips of real people (`make motions`) and a few generated ones, at 20 frames per second. Each is shifted
  so that the person starts half a metre behind the origin and faces it: holosoma cannot start above the origin, and takes
  the direction to it for the person's heading.
* tables: H1 with all three methods, each clip cut to its first `--frames` frames because holosoma is slow; then H1 and X1
  with whole clips, without holosoma (it has no X1).
* measure: all joints are evaluated by `data.metrics` on this project's description of the robot. Joints that a method does
  not have are at rest, fingers at the same opening for all. Hand error is that of the vector from shoulder to hand, foot
  error that of the foot's place, both to the method's own targets after its own scaling; `hand_world_cm` is the distance of
  hands to their targets in the world, for methods that have such. Holosoma follows a mesh and not these places: its errors
  say how far it ends up from the scaled human.
* time: processor time of one thread per frame, the median of the repetitions (holosoma: one). `wall_ms` is by the clock on
  the wall and counts what else the machine does. Loading and compiling do not count.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from retargeters.exchange import Array, Clip, Job, Outcome, Results

from data.contacts import toe_contacts
from data.generator import GENERATOR_VERSION, generate_clip
from data.metrics import Metrics, evaluate_joints
from data.motion import FPS
from data.omomo import find_demo_clips, load_omomo
from data.retarget import Retargeter
from data.skeleton import JOINTS, HumanMotion, index
from data.targets import make_targets
from interface.bodies import SIDES
from robots.leg_ik import crouch
from robots.spec import load_robot

SCRIPTS: Final = Path(__file__).parent / "retargeters"
OURS, MINK, HOLOSOMA = "ours", "mink (GMR)", "holosoma"
#: A walk, a reach to the floor with both hands, a wave, a turn with a push.
GENERATED: Final = (0, 8, 16, 43)
HEIGHTS_M: Final = {"h1": 1.80, "x1": 1.27}
#: Height of a person over leg and back up to the head joint: 1.203 and 1.207 for the OMOMO subjects, whose heights are known.
STATURE: Final = 1.205
START_BEHIND_M: Final = 0.5
AIMS: Final = {MINK: 4.0, HOLOSOMA: 200.0}
AT_LEAST_EQUAL: Final = ("hand_cm", "foot_cm", "skate_cm_s", "self_pct")
HIGHER_IS_BETTER: Final = ("balance_cm",)
#: Properties of the clip, or of the posture that was asked for.
NO_QUALITY: Final = ("human_skate_cm_s", "lowest_pelvis", "frames")


@dataclasses.dataclass(frozen=True, slots=True)
class Column:
    """One method on one set of clips.

    Attributes:
        method: its name.
        metrics: mean over the clips.
        hand_world_cm: distance of hands to their targets in the world; nan without such targets.
        ms: processor milliseconds per frame.
        wall_ms: milliseconds per frame by the clock on the wall.
        clips: metrics of each clip.
    """

    method: str
    metrics: Metrics
    hand_world_cm: float
    ms: float
    wall_ms: float
    clips: dict[str, Metrics]

    def values(self) -> dict[str, float]:
        return {**dataclasses.asdict(self.metrics), "hand_world_cm": self.hand_world_cm, "ms": self.ms, "wall_ms": self.wall_ms}


def load_clips(seed: int) -> list[HumanMotion]:
    real = [load_omomo(path) for path in find_demo_clips() if path.suffix == ".pt"]
    if not real:
        raise SystemExit("the OMOMO clips are not installed; run `make motions` (package holosoma-retargeting, data only)")
    clips = [*real, *(generate_clip(seed, number) for number in GENERATED)]
    return [shifted(HumanMotion(clip.name, clip.joints, clip.fps)) for clip in clips]


def shifted(clip: HumanMotion) -> HumanMotion:
    """The clip with the person half a metre behind the origin and facing it in the first frame."""
    across = clip.joints[0, index("left_hip")] - clip.joints[0, index("right_hip")]
    ahead = np.array([across[1], -across[0], 0.0]) / np.hypot(across[0], across[1])
    start = clip.joints[0, 0] * [1.0, 1.0, 0.0]
    return dataclasses.replace(clip, joints=clip.joints - start - START_BEHIND_M * ahead)


def cut(clip: HumanMotion, frames: int) -> HumanMotion:
    return dataclasses.replace(clip, joints=clip.joints[:frames])


def height_m(joints: Array) -> float:
    """How tall a person is, from joints (T, 22, 3)."""
    chains = (("left_hip", "left_knee", "left_ankle"), ("pelvis", "spine1", "spine2", "spine3", "neck", "head"))
    bones = [np.linalg.norm(joints[:, index(b)] - joints[:, index(a)], axis=1) for chain in chains for a, b in pairwise(chain)]
    return STATURE * float(np.median(bones, axis=1).sum())


def about(retargeter: Retargeter, scale: str) -> dict[str, Any]:
    """What a method may know of the robot."""
    spec, robot = retargeter.spec, retargeter.robot
    low, high = spec.pelvis_height_range_m
    start = crouch(robot, high - 0.1 * (high - low)).q
    return {
        "name": spec.name,
        "mjcf": str(spec.mjcf_path),
        "height_m": HEIGHTS_M[spec.name],
        "root_body": spec.root_body,
        "leg_joints": spec.leg_joints,
        "waist_joints": spec.waist_joints,
        "arm_joints": [spec.arms[side].joints for side in SIDES],
        "joint_names": robot.joint_names,
        "key_bodies": dict(spec.key_bodies),
        "start": dict(zip(robot.joint_names, start.tolist(), strict=True)),
        "limits": dict(zip(robot.joint_names, np.column_stack([robot.lower, robot.upper]).tolist(), strict=True)),
        "scale": scale,
    }


def run(python: str, script: str, job: Job) -> Results:
    """Runs a method in a process of its own, with one thread."""
    threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "RAYON")}
    with tempfile.TemporaryDirectory() as name:
        given, made = Path(name) / "job.npz", Path(name) / "result.npz"
        job.write(given)
        try:
            done = subprocess.run(
                [python, str(SCRIPTS / script), str(given), str(made)],
                capture_output=True,
                text=True,
                env={**os.environ, **threads},
            )
        except OSError as error:
            raise SystemExit(
                f"{script}: {python} does not run ({error.strerror}); expected the Python of its environment"
            ) from error
        if done.returncode or not made.is_file():
            tail = "\n".join(done.stderr.strip().splitlines()[-15:])
            raise SystemExit(f"{script}: {python} ended with {done.returncode}; the end of what it wrote:\n{tail}")
        return Results.read(made)


def whole_body(retargeter: Retargeter, names: Sequence[str], outcome: Outcome, fingers: Array) -> Array:
    """Joints (T, J) of our description: those that a method gives, arms' other joints at rest, fingers as in (J,) `fingers`."""
    robot = retargeter.robot
    unknown = sorted(set(names) - set(robot.joint_names))
    if unknown:
        raise SystemExit(f"joints {unknown} are not in {retargeter.spec.name}; it has: {', '.join(robot.joint_names)}")
    q = np.tile(fingers, (len(outcome.q), 1))
    for arm in retargeter.spec.arms.values():
        q[:, robot.indices(arm.joints)] = arm.rest
    q[:, robot.indices(tuple(names))] = outcome.q
    return q


def own_errors(retargeter: Retargeter, results: Results, outcome: Outcome, q: Array) -> dict[str, float]:
    """Hand and foot errors of a method with points of its own, cm."""
    if outcome.targets is None:
        return {}
    bodies = tuple(body for _, body, _ in results.points)
    poses = np.stack([retargeter.robot.frames(root, joints, bodies) for root, joints in zip(outcome.root, q, strict=True)])
    offsets = np.array([offset for *_, offset in results.points])
    places = poses[..., :3, 3] + np.einsum("tnij,nj->tni", poses[..., :3, :3], offsets)
    roles = [role for role, _, _ in results.points]
    off = 100.0 * (places - outcome.targets)  # (T, N, 3)
    hands, shoulders, feet = (off[:, [roles.index(f"{side}_{r}") for side in SIDES]] for r in ("hand", "shoulder", "foot"))
    hand, foot = np.linalg.norm(hands - shoulders, axis=-1), np.linalg.norm(feet, axis=-1)
    return {
        "hand_cm": float(hand.mean()),
        "hand_p95_cm": float(np.quantile(hand, 0.95)),
        "foot_cm": float(foot.mean()),
        "foot_p95_cm": float(np.quantile(foot, 0.95)),
        "hand_world_cm": float(np.linalg.norm(hands, axis=-1).mean()),
    }


def column(method: str, retargeter: Retargeter, clips: Sequence[HumanMotion], results: Results, fingers: Array) -> Column:
    """Evaluates what a method made."""
    metrics: dict[str, Metrics] = {}
    world = []
    for clip, outcome in zip(clips, results.outcomes, strict=True):
        q = whole_body(retargeter, results.joint_names, outcome, fingers)
        targets = make_targets(clip, retargeter.measures) if method == OURS else None
        found = evaluate_joints(retargeter, outcome.root, q, clip, toe_contacts(clip.joints, clip.fps), targets)
        errors = own_errors(retargeter, results, outcome, q)
        world.append(errors.pop("hand_world_cm", math.nan))
        metrics[clip.name] = dataclasses.replace(found, **errors)
    frames = np.array([len(clip.joints) for clip in clips])
    wall, processor = 1e3 * np.sum([np.median(o.seconds, axis=0) for o in results.outcomes], axis=0) / frames.sum()
    mean = Metrics.mean(list(metrics.values()))
    return Column(method, mean, float(np.average(world, weights=frames)), float(processor), float(wall), metrics)


def record(found: Column) -> dict[str, Any]:
    """Numbers for JSON, which has no nan."""
    known = lambda values: {name: None if math.isnan(value) else value for name, value in values.items()}  # noqa: E731
    return known(found.values()) | {"clips": {name: known(dataclasses.asdict(m)) for name, m in found.clips.items()}}


def digits(value: float) -> str:
    """Three digits, a dash for nan."""
    return "-" if math.isnan(value) else f"{value:.3g}" if abs(value) < 100.0 else f"{value:.0f}"


def table(columns: Sequence[Column]) -> str:
    lines = [f"| metric | {' | '.join(c.method for c in columns)} |", f"|---|{'---:|' * len(columns)}"]
    for name in columns[0].values():
        lines.append(f"| {name} | {' | '.join(digits(c.values()[name]) for c in columns)} |")
    return "\n".join(lines)


def judge(columns: Sequence[Column]) -> list[str]:
    """Which aims were met, and where others are better, in words."""
    ours = columns[0].values()
    said = []
    for other in columns[1:]:
        theirs = other.values()
        ratio, aim = theirs["ms"] / ours["ms"], AIMS[other.method]
        said.append(f"{'met' if ratio >= aim else 'NOT MET'}: {digits(ratio)} times faster than {other.method}, aim {aim:.0f}")
        for name in AT_LEAST_EQUAL:
            met = "met" if ours[name] <= theirs[name] else "NOT MET"
            said.append(f"{met}: {name} {digits(ours[name])}, {other.method} {digits(theirs[name])}")
        better = []
        for name in ours.keys() - {*NO_QUALITY, "ms", "wall_ms", "hand_world_cm"}:
            sign = -1.0 if name in HIGHER_IS_BETTER else 1.0
            if sign * theirs[name] < sign * ours[name] and digits(theirs[name]) != digits(ours[name]):
                better.append(f"{name} {digits(theirs[name])} (ours {digits(ours[name])})")
        said.append(f"{other.method} is better in: {', '.join(sorted(better)) or 'nothing that is measured here'}")
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mink", help="Python of an environment with mink")
    parser.add_argument("--holosoma", help="Python of an environment with holosoma-retargeting")
    parser.add_argument("--frames", type=int, default=60, help="frames of each clip in the table with holosoma")
    parser.add_argument("--repeats", type=int, default=5, help="repetitions for the clock, without holosoma")
    parser.add_argument("--scale", choices=("bones", "height"), default="bones", help="the mink solver's scales")
    parser.add_argument("--seed", type=int, default=0, help="of the generated clips")
    parser.add_argument("--out", type=Path, help="JSON file for all numbers")
    arguments = parser.parse_args()
    if arguments.frames < 5 or arguments.repeats < 1:
        parser.error(f"--frames {arguments.frames} must be at least 5, --repeats {arguments.repeats} at least 1")
    whole = load_clips(arguments.seed)
    short = [cut(clip, arguments.frames) for clip in whole]
    sets = [("h1", whole), ("x1", whole)]
    if arguments.holosoma:
        sets.insert(0, ("h1", short))
    versions: dict[str, dict[str, str]] = {}
    tables: dict[str, Any] = {}
    for robot, clips in sets:
        retargeter = Retargeter(load_robot(robot))
        given = tuple(Clip(clip.name, clip.joints, height_m(clip.joints)) for clip in clips)
        job = Job(about(retargeter, arguments.scale), JOINTS, given, FPS, arguments.repeats)
        methods = [(OURS, sys.executable, "own.py", job)]
        if arguments.mink:
            methods.append((MINK, arguments.mink, "gmr.py", job))
        if clips is short:
            methods.append((HOLOSOMA, arguments.holosoma, "holosoma.py", dataclasses.replace(job, repeats=1)))
        columns: list[Column] = []
        fingers = np.empty(0)
        for method, python, script, work in methods:
            results = run(python, script, work)
            versions[method] = results.versions
            if method == OURS:
                fingers = results.outcomes[0].q[0]
            columns.append(column(method, retargeter, clips, results, fingers))
        title = f"{robot}, {f'first {arguments.frames} frames' if clips is short else 'whole clips'}"
        said = judge(columns)
        print(f"\n## {title}\n\n{table(columns)}\n", *(f"* {line}" for line in said), sep="\n", flush=True)
        tables[title] = {"verdict": said, "methods": {c.method: record(c) for c in columns}}
        if arguments.out:  # after each table, since the first one takes minutes
            rows = {
                "command": " ".join(sys.argv),
                "seed": arguments.seed,
                "generator_version": GENERATOR_VERSION,
                "clips": {clip.name: {"frames": len(clip.joints), "height_m": height_m(clip.joints)} for clip in whole},
                "repeats": arguments.repeats,
                "versions": versions,
                "tables": tables,
            }
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            arguments.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
