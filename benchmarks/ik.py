"""Inverse kinematics: success, residuals and time per solve of both robots. `python benchmarks/ik.py [--count N] [--out FILE]`.

Two sets of targets. `sampled`: grasp poses of random arm postures in front of the body, so every target has a solution and
success should be 100 %. `table`: points on a grid over tables in front of the robot, fingers asked to point forward and palm
sideways, as in a side grasp; success is then a property of the robot's reach, and `at some height` shows what crouching adds.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from sim.robots.build_solver import RobotKit, robot_kit
from sim.robots.kinematics import root_quaternion
from sim.robots.reach import reach_over_heights
from sim.robots.solver import IkResult, ReachTarget, rotation_from_axes
from sim.robots.spec import SIDES, available_robots


def sampled_targets(
    kit: RobotKit, count: int, rng: np.random.Generator
) -> list[tuple[float, dict[str, tuple[np.ndarray, np.ndarray]]]]:
    """Pelvis height and, per arm, position and rotation of a grasp site that some posture reaches in front of the body."""
    robot, low, high = kit.model, *kit.spec.pelvis_height_range_m
    found = []
    while len(found) < count:
        height = float(rng.uniform(low, high))
        q = kit.crouches.at(height).q
        for arm in kit.spec.arms.values():
            index = robot.indices(arm.joints)
            q[index] = np.clip(rng.uniform(-1.5, 1.5, len(index)), robot.lower[index], robot.upper[index])
        root = np.array([0.0, 0.0, 0.0, *root_quaternion(0.0, kit.crouches.pitch(height))])
        poses = robot.frames(root, q, tuple(kit.spec.arms[side].grasp_site for side in SIDES))
        if all(pose[0, 3] > 0.15 and pose[2, 3] + height > 0.1 for pose in poses):
            found.append((height, {side: (pose[:3, 3], pose[:3, :3]) for side, pose in zip(SIDES, poses, strict=True)}))
    return found


def summary(results: list[IkResult], seconds: list[float]) -> dict[str, float]:
    error = np.array([result.position_error_m for result in results])
    ms = 1e3 * np.array(seconds)
    return {
        "targets": len(results),
        "success_percent": 100.0 * float(np.mean([result.success for result in results])),
        "position_error_median_mm": 1e3 * float(np.median(error)),
        "position_error_p95_mm": 1e3 * float(np.percentile(error, 95)),
        "rotation_error_median_deg": float(np.degrees(np.median([result.rotation_error_rad for result in results]))),
        "balance_margin_min_mm": 1e3 * float(np.min([result.balance_margin_m for result in results])),
        "ms_median": float(np.median(ms)),
        "ms_p95": float(np.percentile(ms, 95)),
        "iterations_mean": float(np.mean([result.iterations for result in results])),
    }


def run_sampled(kit: RobotKit, count: int, arms: tuple[str, ...], mode: str, rng: np.random.Generator) -> dict[str, float]:
    results, seconds = [], []
    for height, poses in sampled_targets(kit, count, rng):
        targets = {}
        for arm in arms:
            position, rotation = poses[arm]
            if mode == "position":
                targets[arm] = ReachTarget(position)
            elif mode == "pointing":
                targets[arm] = ReachTarget(position, rotation, 0.3, 0.0)
            else:
                targets[arm] = ReachTarget(position, rotation, 0.3, 0.3)
        start = kit.crouches.at(height).q
        begin = time.perf_counter()
        results.append(kit.solver.solve(targets, start, pelvis_height_m=height))
        seconds.append(time.perf_counter() - begin)
    return summary(results, seconds)


def run_table(kit: RobotKit) -> dict[str, object]:
    """Left arm over tables: per table height, the fraction of points reached standing and at some pelvis height."""
    rotation = rotation_from_axes(np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]))
    rows, seconds = {}, []
    for table_m in (0.3, 0.5, 0.7, 0.9, 1.1, 1.3):
        standing = anywhere = total = 0
        for x in np.arange(0.25, 0.61, 0.07):
            for y in (0.0, 0.15, 0.3):
                begin = time.perf_counter()
                reach = reach_over_heights(kit, "left", np.array([x, y, table_m + 0.06]), rotation)
                seconds.append((time.perf_counter() - begin) / len(reach.heights_m))
                total += 1
                standing += bool(reach.reached[-1])
                anywhere += bool(reach.reached.any())
        rows[f"table {table_m:.1f} m"] = {"standing": standing / total, "at some height": anywhere / total}
    return {"reach": rows, "ms_median": 1e3 * float(np.median(seconds)), "ms_p95": 1e3 * float(np.percentile(seconds, 95))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    report: dict[str, object] = {}
    for name in available_robots():
        kit = robot_kit(name)
        rng = np.random.default_rng(0)
        entry: dict[str, object] = {"pelvis_height_range_m": kit.spec.pelvis_height_range_m}
        for arms in (("left",), SIDES):
            for mode in ("position", "pointing", "pose"):
                entry[f"{'+'.join(arms)} {mode}"] = run_sampled(kit, args.count, arms, mode, rng)
        entry["table"] = run_table(kit)
        report[name] = entry
    text = json.dumps(report, indent=2)
    print(text)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
