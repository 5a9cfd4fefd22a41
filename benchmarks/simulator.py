"""Speed and size of the simulator, every ratio within one run.

    python benchmarks/simulator.py [--only PART ...] [--out FILE] [--robosuite PYTHON]

* planner's view: 224 pixels of the furnished kitchen with H1, against the same scene with MuJoCo's default quality (shadow
maps, multisampling, lights that cast shadows) drawn by `mujoco.Renderer`; depth and segmentation against colours alone. *
skills: simulated seconds per second of one core over a plan with walking, reaching, grasping, placing and a door. * episode: a
reset in a room that has been compiled; growth: metadata and resets with 10, 40 and 100 objects; memory: a process with one
environment that has acted and rendered. * robosuite: with `--robosuite`, the Python of an environment that has robosuite (it
needs another MuJoCo), TwoArmLift is stepped in a process of its own: real-time factor without a camera, and camera frames per
second at 256 pixels, against ours.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import sim.tasks
from interface.steps import PlanStep
from robots.spec import load_robot
from sim.interfaces.metadata import world_metadata
from sim.scene.compiler import build_spec
from sim.scene.objects import ObjectPlacement
from sim.session.session import FreePlay, Session
from sim.tasks.task import load_benchmark
from sim.world.scene_state import scene_key
from sim.world.world import World

ROOM = "kitchen_1"
CERTIFICATES = Path(sim.tasks.__file__).parent / "certificates.jsonl"
ROBOSUITE = """
import json, sys, time
import numpy as np
import robosuite
camera = sys.argv[1] == "camera"
env = robosuite.make("TwoArmLift", robots=["Panda", "Panda"], has_renderer=False, has_offscreen_renderer=camera,
                     use_camera_obs=camera, camera_names="frontview", camera_heights=256, camera_widths=256, horizon=100000)
env.reset()
low, high = env.action_spec
rng = np.random.default_rng(0)
for _ in range(10):
    env.step(rng.uniform(low, high))
steps, started = 0, time.perf_counter()
while time.perf_counter() - started < 10.0:
    env.step(rng.uniform(low, high))
    steps += 1
seconds = time.perf_counter() - started
print(json.dumps({"steps_per_s": steps / seconds, "real_time": steps / env.control_freq / seconds}))
"""


def median_ms(run: Callable[[], Any], count: int = 15, warm: int = 3) -> float:
    for _ in range(warm):
        run()
    times = []
    for _ in range(count):
        started = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times)


def default_renderer(world: World, size: int) -> Callable[[], Any]:
    """Draws the same scene as MuJoCo does when nobody tells it otherwise."""
    import mujoco  # sim, above, has chosen the OpenGL backend

    spec = build_spec(scene_key(world.robot, world.room, [name for name, obj in world.objects.items() if obj.movable]))
    plain = mujoco.MjSpec()
    visual: Any = spec.visual
    visual.quality.offsamples = plain.visual.quality.offsamples
    visual.quality.shadowsize = plain.visual.quality.shadowsize
    for light in spec.worldbody.lights:
        light.castshadow = True
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = world.data.qpos
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, size, size)

    def draw() -> Any:
        renderer.update_scene(data, camera=world.robot.head_camera if world.robot else "overview")
        return renderer.render()

    return draw


def views(size: int = 224) -> dict[str, float]:
    world = World(load_robot("h1"), "kitchen_1")
    ours = median_ms(lambda: world.cameras.render("head", size, size))
    depth = median_ms(lambda: world.cameras.render("head", size, size, depth=True))
    labels = median_ms(lambda: world.cameras.render("head", size, size, segmentation=True))
    both = median_ms(lambda: world.cameras.render("head", size, size, depth=True, segmentation=True))
    default = median_ms(default_renderer(world, size), count=5, warm=1)
    return {
        "rgb_ms": ours,
        "rgb_depth_ms": depth,
        "rgb_segmentation_ms": labels,
        "rgb_depth_segmentation_ms": both,
        "default_ms": default,
        "default_over_ours": default / ours,
        "depth_over_rgb": (depth - ours) / ours,
        "segmentation_over_rgb": (labels - ours) / ours,
    }


def skills(robot: str) -> dict[str, float]:
    """The expert's plans for every third task of the benchmark, as its certificates have them."""
    plans = {
        row["task"]: row["plan"] for row in map(json.loads, CERTIFICATES.read_text().splitlines()) if row["robot"] == robot
    }
    session = Session(robot, image_size=0, all_known=True)
    simulated = wall = 0.0
    steps = done = 0
    for task in load_benchmark()[::3]:
        session.reset(task, 0)
        for text in plans[task.id]:
            started, at = time.perf_counter(), session.world.time_s
            feedback = session.act(PlanStep.parse(text))
            wall += time.perf_counter() - started
            simulated += session.world.time_s - at
            steps, done = steps + 1, done + feedback.success
    return {"simulated_s": simulated, "wall_s": wall, "real_time": simulated / wall, "succeeded": done, "steps": steps}


def crowded(count: int) -> list[ObjectPlacement]:
    """That many eggs on the worktops and tables of a kitchen, in rows."""
    bare = World(None, ROOM, [], settle_s=0.0)
    egg = bare.catalogue.get("Egg")
    radius = 0.5 * float(np.hypot(*egg.size[:2]))
    found: list[ObjectPlacement] = []
    for name, item in bare.objects.items():
        for surface in (one for one in item.surfaces if not one.spec.inside):
            cx, cy, sx, sy = surface.spec.rect
            grid = np.stack(np.meshgrid(*(np.arange(-0.45 * side, 0.45 * side, 0.13) for side in (sx, sy))), axis=-1).reshape(
                -1, 2
            )
            turn = bare.data.xmat[surface.body_id].reshape(3, 3)[:2, :2]
            for point in grid + (cx, cy):
                xy = bare.data.xpos[surface.body_id, :2] + turn @ (point - surface.origin[:2])
                spot = bare.containment.free_spot(name, radius, height_m=egg.size[2], near=xy, gap_m=0.0, band_m=10.0)
                if spot is not None and float(np.linalg.norm(spot[:2] - xy)) < 0.02:
                    found.append(ObjectPlacement(f"Egg_{len(found) + 1}", name, (float(xy[0]), float(xy[1]))))
                if len(found) == count:
                    return found
    raise ValueError(f"{ROOM} has room for {len(found)} eggs, wanted {count}")


def growth() -> dict[str, float]:
    """What metadata and a new world cost with 10, 40 and 100 movable objects; the room's furniture comes on top."""
    rows: dict[str, float] = {}
    robot = load_robot("h1")
    for count in (10, 40, 100):
        placements = crowded(count)
        world = World(robot, ROOM, placements)

        def asked(world: World = world) -> Any:
            world.data.qpos[0] += 1e-9  # nothing is remembered from the last time
            return world_metadata(world)

        def made(placements: list[ObjectPlacement] = placements) -> Any:
            return World(robot, ROOM, placements)

        rows[f"metadata_{count}_ms"] = median_ms(asked)
        rows[f"reset_{count}_ms"] = median_ms(made, count=5, warm=1)
    return rows


def episodes() -> dict[str, float]:
    session = Session("h1", image_size=0)
    task = FreePlay("kitchen_1")
    return {"new_episode_ms": median_ms(lambda: session.reset(task, 0), count=9)}


def camera_frames(size: int = 256) -> dict[str, float]:
    """Control steps of 20 ms with a whole furnished room, without a camera and with one picture per step."""
    session = Session("h1", image_size=0, all_known=True)
    session.reset(FreePlay("kitchen_1"), 0)
    world, rates = session.world, {}
    arm = session.robot.arms["left"]
    rng = np.random.default_rng(0)
    for name, camera in (("plain", False), ("camera", True)):
        steps, started = 0, time.perf_counter()
        while time.perf_counter() - started < 5.0:
            world.servos.set_joint_targets(
                {joint: rest + rng.uniform(-0.2, 0.2) for joint, rest in zip(arm.joints, arm.rest, strict=True)}
            )
            world.advance(0.05)
            if camera:
                world.cameras.render("head", size, size)
            steps += 1
        seconds = time.perf_counter() - started
        rates |= {f"{name}_steps_per_s": steps / seconds, f"{name}_real_time": 0.05 * steps / seconds}
    return rates


def memory() -> dict[str, float]:
    """Unshared and shared resident memory of a process with one environment, megabytes."""
    code = (
        "from sim.session.session import Session, FreePlay\nfrom interface.steps import PlanStep\n"
        "s = Session('h1', image_size=224)\ns.reset(FreePlay('kitchen_1'), 0)\n"
        "for t in ('GoTo(Bottle_1)', 'Pick(left, Bottle_1)'): s.step(PlanStep.parse(t))\n"
        "rows = dict(l.split(':') for l in open('/proc/self/smaps_rollup').read().splitlines()[1:])\n"
        "print(int(rows['Pss'].split()[0]) / 1e3, int(rows['Private_Dirty'].split()[0]) / 1e3)\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    return {"resident_mb": float(out[0]), "private_mb": float(out[1])}


def robosuite(python: str) -> dict[str, Any]:
    rows = {}
    for mode in ("plain", "camera"):
        done = subprocess.run([python, "-c", ROBOSUITE, mode], capture_output=True, text=True, check=True)
        rows[mode] = json.loads(done.stdout.strip().splitlines()[-1])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--robosuite", help="Python of an environment with robosuite")
    parts: dict[str, Callable[[], dict[str, float]]] = {
        "views": views,
        "skills_h1": lambda: skills("h1"),
        "skills_x1": lambda: skills("x1"),
        "episodes": episodes,
        "growth": growth,
        "steps": camera_frames,
        "memory": memory,
    }
    parser.add_argument("--only", nargs="+", choices=tuple(parts), default=tuple(parts), help="what is measured")
    arguments = parser.parse_args()
    rows: dict[str, Any] = {name: parts[name]() for name in arguments.only}
    if arguments.robosuite and "steps" in rows:
        other = rows["robosuite"] = robosuite(arguments.robosuite)
        rows["against_robosuite"] = {
            "real_time_ratio": rows["steps"]["plain_real_time"] / other["plain"]["real_time"],
            "camera_frames_ratio": rows["steps"]["camera_steps_per_s"] / other["camera"]["steps_per_s"],
        }
    for title, values in rows.items():
        print(title)
        for name, value in values.items():
            print(f"  {name:28s} {value if not isinstance(value, float) else round(value, 3)}")
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
