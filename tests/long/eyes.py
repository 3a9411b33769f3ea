"""Compares what eyes see with MuJoCo's own renderer, and times them.

    MUJOCO_GL=osmesa python -m tests.long.eyes             # 100 states each: 2 minutes
    python -m tests.long.eyes --speed                      # pictures a second

Depth is compared where both hit something: along the eye's axis, to 1% or 1 mm. OpenGL draws a
sphere as many flat triangles, and an outline one pixel off: that is what differs.
"""

import argparse
import dataclasses
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl import eyes
from purerl.envs import run, sight
from purerl.envs.compose import PREFIX, compose
from purerl.physics import lookup

BODIES = {
    "ant": {},
    "rodent": {"platform_length": (0.4, 0.8), "gap_length": (0.05, 0.2), "corridor_width": 2.0},
}
FAR = 20.0  # [m]


def main() -> None:
    """Prints a line for each body."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=100)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--speed", action="store_true")
    words = parser.parse_args()
    for body, arena in BODIES.items():
        if words.speed:
            speed(body, arena)
        else:
            hits, right, seen = compare(body, arena, words.states, words.size)
            share = right / hits
            print(f"{body}: {share:.4%} of {hits:,} pixels agree; {seen} kinds of geom are seen")
            assert share > 0.999


def states(env: run.Run, number: int) -> tuple:
    """Random places along a corridor, poses and courses: xpos, xmat, boxes and qpos, [N, ...]."""
    random, model = np.random.default_rng(0), env.physics.model

    def one(key, qpos):
        state = env.reset(key)
        state = state.replace(physics=state.physics.replace(qpos=qpos))
        _, readings = env.physics.init(qpos, jnp.zeros(model.nv), env.model_changes(state))
        return readings.xpos, readings.xmat, env.scenery(state), qpos

    qpos = np.tile(model.qpos0, (number, 1))
    qpos[:, 0] = random.uniform(4, 30, number)
    qpos[:, 2] *= random.uniform(1.0, 2.0, number)
    turn = np.array([1, 0, 0, 0]) + 0.15 * random.normal(size=(number, 4))
    qpos[:, 3:7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    qpos[:, 7:] += 0.15 * random.normal(size=(number, model.nq - 7))
    keys = jax.random.split(jax.random.key(0), number)
    return jax.jit(jax.vmap(one))(keys, jnp.float32(qpos))


def compare(body: str, arena: dict, number: int, size: int) -> tuple[int, int, int]:
    """Returns pixels that both hit, those that agree, and kinds of geom that were seen."""
    env = run.build(run.Options(body=body, arena="gaps", **arena), "c")
    xpos, xmat, boxes, qpos = states(env, number)
    wide = dataclasses.replace(env.parts.arena, boxes=boxes[0].shape[1])  # all platforms
    parts = compose(env.parts.body, wide, "c")
    model, platforms = parts.looks, list(parts.boxes.boxes)
    model.geom_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.vis.map.znear, model.vis.map.zfar = 5e-4 / model.stat.extent, 30 / model.stat.extent
    model.vis.quality.numslices = model.vis.quality.numstacks = 200
    camera = f"{PREFIX}{env.parts.body.camera}"
    window = [lookup.names(env.parts.looks, "geom")[i] for i in env.parts.boxes.boxes]
    eye = eyes.of_camera(env.parts.looks, camera)
    ours = eyes.Eyes(env.parts.looks, [eye], (size, size), reach=FAR, hide=window)
    distance = np.asarray(jax.jit(jax.vmap(ours.distance))(xpos, xmat, boxes))
    data, hits, right, seen = mujoco.MjData(model), 0, 0, set()
    with mujoco.Renderer(model, size, size, max_geom=2000) as renderer:
        renderer.enable_depth_rendering()
        for i in range(number):
            data.qpos[:] = qpos[i]
            model.geom_pos[platforms], model.geom_size[platforms] = boxes[0][i], boxes[1][i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera)
            depth, found = renderer.render(), distance[i, 0] / ours.stretch.reshape(size, size)
            both = np.isfinite(found) & (depth < FAR)
            error = np.abs(found - depth)[both]
            hits += both.sum()
            right += (error < np.maximum(0.01 * depth[both], 1e-3)).sum()
            seen |= set(model.geom_type.tolist())
    return int(hits), int(right), len(seen)


def speed(body: str, arena: dict) -> None:
    """Prints pictures of 32 x 32 a second, of the body in its corridor, and as a CPU's second."""
    env = run.build(run.Options(body=body, arena="gaps", eyes=sight.Sight(number=1), **arena), "c")
    assert env.eyes is not None
    see = jax.jit(jax.vmap(env.eyes.see))
    places = states(env, 256)[:3]
    begun = time.perf_counter()
    see(*places).block_until_ready()
    compiled = time.perf_counter() - begun
    begun, cpu = time.perf_counter(), time.process_time()
    for _ in range(20):
        see(*places).block_until_ready()
    wall, used = time.perf_counter() - begun, time.process_time() - cpu
    print(
        f"{body}: {20 * 256 / wall:,.0f} pictures/s, {20 * 256 / used:,.0f} a second of a core; "
        f"compiled in {compiled:.1f} s"
    )


if __name__ == "__main__":
    main()
