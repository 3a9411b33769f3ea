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
from purerl.envs import bowls, escape_bowl, run, sight
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
    for body in () if words.speed else BODIES:
        hits, right = compare_bowl(body, words.states, words.size)
        print(f"{body} in a bowl: {right / hits:.4%} of {hits:,} pixels agree")
        assert right / hits > 0.999


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
    look_close(model)
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
            more = agreeing(renderer.render(), distance[i, 0] / ours.stretch.reshape(size, size))
            hits, right = hits + more[0], right + more[1]
            seen |= set(model.geom_type.tolist())
    return int(hits), int(right), len(seen)


def compare_bowl(body: str, number: int, size: int) -> tuple[int, int]:
    """As `compare`, anywhere in bowls: pixels that both hit, and those that agree."""
    env = escape_bowl.build(escape_bowl.Options(body=body), "c")
    model, random = env.parts.looks, np.random.default_rng(0)
    look_close(model)
    camera = f"{PREFIX}{env.parts.body.camera}"
    ours = eyes.Eyes(model, [eyes.of_camera(model, camera)], (size, size), reach=FAR)
    see = jax.jit(ours.distance)
    draw = jax.jit(lambda key: env.reset(key).task["terrain"])
    heights = jax.jit(lambda terrain: bowls.heights(env.bowl, terrain))
    data, hits, right = mujoco.MjData(model), 0, 0
    for i in range(number):
        place = random.uniform(-5, 5, 2)
        terrain = draw(jax.random.key(i))
        ground, _ = bowls.ground(env.bowl, terrain, jnp.float32(place)[None])
        data.qpos[:] = model.qpos0
        data.qpos[:2] = place
        data.qpos[2] += float(ground[0]) + 0.1 * random.random()
        turn = np.array([1, 0, 0, 0]) + 0.15 * random.normal(size=4)
        turn[3] = random.normal()
        data.qpos[3:7] = turn / np.linalg.norm(turn)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        high = heights(terrain)
        model.hfield_data[:] = np.asarray(high).ravel() / env.bowl.height
        xpos, xmat = jnp.float32(data.xpos), jnp.float32(data.xmat.reshape(-1, 3, 3))
        found = np.asarray(see(xpos, xmat, None, high))[0]
        # A renderer keeps the heights that it was made with.
        with mujoco.Renderer(model, size, size, max_geom=2000) as renderer:
            renderer.enable_depth_rendering()
            renderer.update_scene(data, camera)
            more = agreeing(renderer.render(), found / ours.stretch.reshape(size, size))
        hits, right = hits + more[0], right + more[1]
    return hits, right


def look_close(model: mujoco.MjModel) -> None:
    """Lets a renderer draw what is near, and round shapes round."""
    model.vis.map.znear, model.vis.map.zfar = 5e-4 / model.stat.extent, 30 / model.stat.extent
    model.vis.quality.numslices = model.vis.quality.numstacks = 200


def agreeing(depth: np.ndarray, found: np.ndarray) -> tuple[int, int]:
    """Returns how many pixels both hit, and how many of them to 1% or 1 mm."""
    both = np.isfinite(found) & (depth < FAR)
    error = np.abs(found - depth)[both]
    return int(both.sum()), int((error < np.maximum(0.01 * depth[both], 1e-3)).sum())


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
