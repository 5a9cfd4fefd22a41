"""Inverse kinematics: success, residuals and time per solve of both robots. `python benchmarks/ik.py [--count N] [--out FILE]`.

Three sets of targets. `grid`: hand poses on a grid before the robot at several pelvis heights, fingers ahead and palms inward,
as the paper's solvers take them (X1 each arm, H1 both hands at once), with and without the rows that keep the robot out of
itself; success is a property of the robot's reach. `sampled`: grasp poses of random arm postures that do not run into the
body, so every target has a solution and success should be near 100 %. `table`: points on a grid over tables in front of the
robot, as in a side grasp; `at some height` shows what crouching adds. `--grid` does the first set only.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from interface.bodies import SIDES
from robots.build_solver import SOLVERS, RobotKit, robot_kit
from robots.kinematics import root_quaternion
from robots.self_collision import SELF_TOUCH_M
from robots.solver import ArmSolver, IkResult, ReachTarget, rotation_from_axes
from robots.spec import available_robots

Array = NDArray[np.float64]

#: The grid: shares of the arm's reach ahead of the pelvis, metres left of it (right for the right arm), shares of the reach
#: above the shoulder.
AHEAD, ASIDE_M, ABOVE = (0.3, 0.45, 0.6, 0.75, 0.9), (0.05, 0.15, 0.25, 0.35), (-0.9, -0.6, -0.3, 0.0, 0.3)
HEIGHTS = 3
TOLERANCE_M = 0.01


def grid_targets(kit: RobotKit, height_m: float) -> list[dict[str, ReachTarget]]:
    """Targets of both arms at one pelvis height, in the pelvis heading frame."""
    root = np.array([0.0, 0.0, 0.0, *root_quaternion(0.0, kit.crouches.pitch(height_m))])
    q = kit.crouches.at(height_m).q
    index = kit.model.indices(kit.spec.arms["left"].joints)
    q[index] = 0.0
    frames = (kit.spec.key_bodies["left_shoulder"], kit.spec.key_bodies["left_elbow"], kit.spec.arms["left"].grasp_site)
    shoulder, elbow, hand = kit.model.frames(root, q, frames)[:, :3, 3]
    reach = float(np.linalg.norm(elbow - shoulder) + np.linalg.norm(hand - elbow))
    found = []
    for x in AHEAD:
        for y in ASIDE_M:
            for z in ABOVE:
                pair = {}
                for side, sign in (("left", 1.0), ("right", -1.0)):
                    point = np.array([x * reach, sign * y, shoulder[2] + z * reach])
                    rotation = rotation_from_axes(np.array([1.0, 0.0, 0.0]), np.array([0.0, -sign, 0.0]))
                    pair[side] = ReachTarget.from_pose(
                        np.block([[rotation, point[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
                    )
                if point[2] + height_m > 0.1:
                    found.append(pair)
    return found


def run_grid(kit: RobotKit, solver: ArmSolver, arms: tuple[str, ...], height_m: float) -> tuple[list[IkResult], list[float]]:
    """Results and processor seconds of all targets of one pelvis height."""
    start = kit.crouches.at(height_m).q
    results, seconds = [], []
    targets = [{arm: pair[arm] for arm in arms} for pair in grid_targets(kit, height_m)]
    solver.solve(targets[0], start, pelvis_height_m=height_m)  # the model of a height is made once
    for target in targets:
        begin = time.process_time()
        results.append(solver.solve(target, start, pelvis_height_m=height_m, tolerance_m=TOLERANCE_M))
        seconds.append(time.process_time() - begin)
    return results, seconds


def grid_row(results: list[IkResult], seconds: list[float]) -> dict[str, float]:
    """Figures of a grid: `self_collision_percent` is of the postures that have their hands in place, residuals of successes."""
    placed = [r for r in results if r.position_error_m <= TOLERANCE_M and r.balance_margin_m > 0.0]
    good = [r for r in placed if r.success] or results
    inside = [r.self_clearance_m < -SELF_TOUCH_M for r in placed]
    return {
        "targets": len(results),
        "success_percent": 100.0 * float(np.mean([r.success for r in results])),
        "error_mm": 1e3 * float(np.median([r.position_error_m for r in good])),
        "error_p95_mm": 1e3 * float(np.percentile([r.position_error_m for r in good], 95)),
        "error_deg": float(np.degrees(np.median([r.rotation_error_rad for r in good]))),
        "error_p95_deg": float(np.degrees(np.percentile([r.rotation_error_rad for r in good], 95))),
        "balance_min_mm": 1e3 * min(r.balance_margin_m for r in good),
        "self_collision_percent": 100.0 * float(np.mean(inside)) if inside else 0.0,
        "ms_median": 1e3 * float(np.median(seconds)),
        "ms_mean": 1e3 * float(np.mean(seconds)),
    }


def report_grid(kit: RobotKit) -> dict[str, dict[str, float]]:
    """The grid's figures by arms, pelvis height and whether the rows are on; prints them as a table."""
    found: dict[str, dict[str, float]] = {}
    solvers = {on: SOLVERS[kit.spec.solver](kit.model, kit.crouches, on == "on") for on in ("off", "on")}
    sets = (SIDES,) if kit.spec.solver == "whole_body" else tuple((side,) for side in SIDES)
    print("\n| robot | arms | pelvis m | rows | success % | mm (95 %) | degrees (95 %) | balance mm | inside % | ms |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for arms in sets:
        everything: dict[str, tuple[list[IkResult], list[float]]] = {on: ([], []) for on in solvers}
        for height in (*np.linspace(*kit.spec.pelvis_height_range_m, HEIGHTS), None):
            for on, solver in solvers.items():
                if height is None:
                    results, seconds = everything[on]
                else:
                    results, seconds = run_grid(kit, solver, arms, float(height))
                    everything[on][0].extend(results)
                    everything[on][1].extend(seconds)
                row = grid_row(results, seconds)
                name = "all" if height is None else f"{height:.2f}"
                found[f"{'+'.join(arms)} {name} {on}"] = row
                print(
                    f"| {kit.spec.name} | {'+'.join(arms)} | {name} | {on} | {row['success_percent']:.0f} | "
                    f"{row['error_mm']:.1f} ({row['error_p95_mm']:.1f}) | "
                    f"{row['error_deg']:.0f} ({row['error_p95_deg']:.0f}) | "
                    f"{row['balance_min_mm']:.0f} | {row['self_collision_percent']:.0f} | "
                    f"{row['ms_median']:.1f} ({row['ms_mean']:.1f}) |",
                    flush=True,
                )
    return found


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
        if all(pose[0, 3] > 0.15 and pose[2, 3] + height > 0.1 for pose in poses) and robot.own_body.clearance_m(q) > 0.01:
            found.append((height, {side: (pose[:3, 3], pose[:3, :3]) for side, pose in zip(SIDES, poses, strict=True)}))
    return found


def summary(results: list[IkResult], seconds: list[float]) -> dict[str, float]:
    """Figures over some solves."""
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
    """Figures over sampled targets; `mode` is `position`, `pointing` or `pose`."""
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


def reached(kit: RobotKit, arm: str, point_in_base: Array, rotation: Array | None = None, heights: int = 5) -> list[bool]:
    """Whether an arm gets to a point (3,), metres ahead of and left of the pelvis and above the floor, from the pelvis heights
    of the robot's range, ascending."""
    found = []
    for height in np.linspace(*kit.spec.pelvis_height_range_m, heights):
        target = ReachTarget(point_in_base - np.array([0.0, 0.0, height]), rotation)
        start = kit.crouches.at(float(height)).q
        found.append(kit.solver.solve({arm: target}, start, pelvis_height_m=float(height), restarts=1).success)
    return found


def run_table(kit: RobotKit) -> dict[str, object]:
    """Left arm over tables: per table height, the fraction of points reached standing and at some pelvis height."""
    rotation = rotation_from_axes(np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]))
    rows, seconds = {}, []
    for table_m in (0.3, 0.5, 0.7, 0.9, 1.1, 1.3):
        standing = anywhere = total = 0
        for x in np.arange(0.25, 0.61, 0.07):
            for y in (0.0, 0.15, 0.3):
                begin = time.perf_counter()
                there = reached(kit, "left", np.array([x, y, table_m + 0.06]), rotation)
                seconds.append((time.perf_counter() - begin) / len(there))
                total += 1
                standing += there[-1]
                anywhere += any(there)
        rows[f"table {table_m:.1f} m"] = {"standing": standing / total, "at some height": anywhere / total}
    return {"reach": rows, "ms_median": 1e3 * float(np.median(seconds)), "ms_p95": 1e3 * float(np.percentile(seconds, 95))}


def main() -> None:
    """Prints the report and writes it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--grid", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    report: dict[str, object] = {}
    for name in available_robots():
        kit = robot_kit(name)
        rng = np.random.default_rng(0)
        entry: dict[str, object] = {"pelvis_height_range_m": kit.spec.pelvis_height_range_m}
        entry["grid"] = report_grid(kit)
        for arms in () if args.grid else (("left",), SIDES):
            for mode in ("position", "pointing", "pose"):
                entry[f"{'+'.join(arms)} {mode}"] = run_sampled(kit, args.count, arms, mode, rng)
        if not args.grid:
            entry["table"] = run_table(kit)
        report[name] = entry
    text = json.dumps(report, indent=2)
    print("\n" + text)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
