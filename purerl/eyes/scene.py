"""What eyes see of a model: distances and grey pictures, from where its bodies are.

Rays are cast against the model's geometries as they were compiled, whatever an engine collides
with. What an eye cannot have in view is left out first, by its bounding sphere; of the rest, one
shape after another is held against all rays of a picture, and the nearest entry stays.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl.core.errors import unknown_name
from purerl.core.records import Array
from purerl.eyes.eye import Eye, place, rays
from purerl.eyes.shapes import KINDS, Kind
from purerl.physics import lookup

LIGHT = np.array([0.3, 0.2, 0.93], np.float32)  # where light comes from, a unit vector
SHADE = 0.4  # of the light, what a surface turned away from it still has
CONTRAST = 0.4  # of the checks on what stands still, which have 1 +- this of the surface's grey
BOX_GREY = 0.5  # of an episode's boxes
SKY, ABYSS = 0.9, 0.0  # grey of a ray that meets nothing, upwards and downwards
GREY = np.array([0.299, 0.587, 0.114])  # of red, green and blue
_GEOM = mujoco.mjtGeom


class Shapes(NamedTuple):
    """Shapes in the frames of bodies, those of one kind together, in the order of `KINDS`."""

    body: np.ndarray  # [S]
    position: np.ndarray  # [S, 3] [m]
    axes: np.ndarray  # [S, 3, 3]; columns: the shape's x, y, z
    scale: np.ndarray  # [S, 3] what a unit shape is multiplied by [m]
    length: np.ndarray  # [S] of a capsule and a cylinder, half, over its radius
    radius: np.ndarray  # [S] of the bounding sphere [m]
    grey: np.ndarray  # [S] 0 to 1
    kind: np.ndarray  # [S] index in KINDS


class Seen(NamedTuple):
    """Shapes in the frame of one eye."""

    turn: Array  # [S, 3, 3] from the eye's frame into the shape's own, scaled
    origin: Array  # [S, 3] of the eye, there
    light: Array  # [S, 3] where light comes from, in the shape's own, not scaled
    scale: Array  # [S, 3] [m]
    length: Array  # [S]
    radius: Array  # [S] of the bounding sphere [m]
    center: Array  # [S, 3] of it, in the eye's frame [m]
    grey: Array  # [S]
    checked: Array  # [S] bool: stands still, so it has checks


class Eyes:
    """Eyes of a model's bodies; `see` and `distance` are pure functions of one simulation."""

    def __init__(
        self,
        model: mujoco.MjModel,
        eyes: Sequence[Eye],
        size: tuple[int, int] = (32, 32),
        reach: float = 4.0,
        hide: Sequence[str] = (),
        check: float = 0.1,
    ):
        """Takes what is seen from a model.

        Args:
          model: the body and what stands around it, as it should look: an engine's may be simpler.
          eyes: of one fovy: E.
          size: (H, W) of a picture, in pixels.
          reach: how far they see [m].
          hide: names of geoms not seen, or of bodies not seen with all that hangs on them.
          check: edge of a square of the pattern on what stands still [m].

        Raises:
          ValueError: an unknown body or geom, a geom of a kind that rays cannot meet, another fovy.
        """
        if len({eye.fovy for eye in eyes}) != 1:
            raise ValueError(f"The eyes have fovy {[e.fovy for e in eyes]}; give at least one eye, "
                             "and all of them one fovy.")  # fmt: skip
        if min(size) < 1 or reach <= 0 or check <= 0:
            raise ValueError(f"size is {size}, reach {reach} and check {check}; all are above 0.")
        self.eyes, self.size, self.reach, self.check = tuple(eyes), tuple(size), reach, check
        self.places = [place(model, eye) for eye in eyes]
        self.shapes = shapes_of(model, hide)
        self.rays = rays(eyes[0].fovy, size)
        self.stretch = np.sqrt(1.0 + np.square(self.rays).sum(0))  # a ray's length, 1 m ahead

    def see(self, xpos: Array, xmat: Array, boxes: tuple[Array, Array] | None = None) -> Array:
        """Returns grey pictures, [E, H, W] uint8, upper row first.

        Args:
          xpos: of the model's bodies [nbody, 3] [m], a reading.
          xmat: their axes [nbody, 3, 3], a reading.
          boxes: what stands around in this episode: centers and half sizes, [P, 3] each [m].
        """
        return self._each(self._picture, xpos, xmat, boxes)

    def distance(self, xpos: Array, xmat: Array, boxes: tuple[Array, Array] | None = None) -> Array:
        """Returns how far what is seen is along each ray, [E, H, W] [m]; inf: nothing there."""
        return self._each(lambda t, *_: t * self.stretch, xpos, xmat, boxes)

    def _each(
        self,
        answer: Callable[..., Array],
        xpos: Array,
        xmat: Array,
        boxes: tuple[Array, Array] | None,
    ) -> Array:
        """Returns what `answer` makes of each eye's entries, [E, H, W]."""
        body = np.array([p.body for p in self.places])
        inner = np.stack([p.position for p in self.places])
        position = xpos[body] + _times(xmat[body], inner[:, :, None])[:, :, 0]
        axes = _times(xmat[body], np.stack([p.axes for p in self.places]))
        episode = np.full(len(boxes[0]) if boxes else 0, list(KINDS).index(_GEOM.mjGEOM_BOX))
        kinds = np.concatenate([self.shapes.kind, episode])

        def one(position: Array, axes: Array) -> Array:
            seen = in_frame(self.shapes, xpos, xmat, boxes, position, axes)
            visible = in_view(seen, self.rays, self.reach)
            t, which = nearest(seen, visible, kinds, self.rays)
            t = jnp.where(t * self.stretch <= self.reach, t, jnp.inf)
            return answer(t, which, seen, kinds, position, axes).reshape(self.size)

        return jax.vmap(one)(position, axes)

    def _picture(
        self, t: Array, which: Array, seen: Seen, kinds: np.ndarray, position: Array, axes: Array
    ) -> Array:
        """Returns the grey of each pixel, [H * W] uint8."""
        right, up = self.rays
        ray = [axes[k, 0] * right + axes[k, 1] * up - axes[k, 2] for k in range(3)]
        there = jnp.isfinite(t)
        # Checks are of a place a little behind the surface. On a floor, z is 0 or 1e-7 below.
        depth = jnp.where(there, t + 0.1 * self.check, 0.0)
        cells = [
            jnp.floor((p + depth * x) / self.check) for p, x in zip(position, ray, strict=True)
        ]
        light, facing = lit(jnp.where(there, t, 0.0), which, seen, kinds, self.rays)
        # Checks smaller than two pixels fade into their mean, or they would be noise.
        pixel = 2.0 * float(np.abs(self.rays[1]).max()) / self.size[0] * t
        fade = jnp.clip((self.check * facing / pixel - 0.5) / 1.5, 0.0, 1.0)
        checks = CONTRAST * fade * (2.0 * ((cells[0] + cells[1] + cells[2]) % 2.0) - 1.0)
        grey = seen.grey[which] * (SHADE + (1.0 - SHADE) * light)
        grey *= jnp.where(seen.checked[which], 1.0 + checks, 1.0)
        grey = jnp.where(there, grey, jnp.where(ray[2] > 0.0, SKY, ABYSS))
        return jnp.round(255.0 * jnp.clip(grey, 0.0, 1.0)).astype(jnp.uint8)


def shapes_of(model: mujoco.MjModel, hide: Sequence[str] = ()) -> Shapes:
    """Returns a model's geoms that can be seen as shapes; `hide`: names of geoms and of bodies."""
    order = {int(kind): number for number, kind in enumerate(KINDS)}
    hidden = _hidden(model, hide)
    seen = [i for i in range(model.ngeom) if i not in hidden]
    for i in seen:
        if model.geom_type[i] not in order:
            kind = _GEOM(model.geom_type[i]).name.removeprefix("mjGEOM_").lower()
            raise ValueError(
                f"Eyes do not see a {kind}, and geom {model.geom(i).name or i!r} is one: name it "
                "or its body in `hide`, or put a simpler geom in its place."
            )
    seen.sort(key=lambda i: order[model.geom_type[i]])
    kind = np.array([order[model.geom_type[i]] for i in seen], int)
    kinds = list(KINDS.values())
    scale = np.array([kinds[k].scale(model.geom_size[i]) for k, i in zip(kind, seen, strict=True)])
    scale = scale.reshape(-1, 3)
    shapes = Shapes(
        body=model.geom_bodyid[seen],
        position=model.geom_pos[seen],
        axes=np.array([_axes(quat) for quat in model.geom_quat[seen]]).reshape(-1, 3, 3),
        scale=scale,
        length=model.geom_size[seen, 1] / scale[:, 0],
        radius=np.where(kind == 0, np.inf, model.geom_rbound[seen]),
        grey=np.array([_grey(model, i) for i in seen]),
        kind=kind,
    )
    return Shapes(*(np.float32(x) if x.dtype == float else x for x in shapes))


def _hidden(model: mujoco.MjModel, hide: Sequence[str]) -> set[int]:
    """Returns the geoms that are not drawn: named, on a named body, clear, of group 3 and above."""
    bodies, geoms = lookup.names(model, "body"), lookup.names(model, "geom")
    for name in hide:
        if name not in bodies + geoms:
            raise ValueError(unknown_name("body or geom in hide", name, bodies + geoms))
    below = np.zeros(model.nbody, bool)
    for i in range(model.nbody):
        below[i] = bodies[i] in hide or (i > 0 and below[model.body_parentid[i]])
    clear = (model.geom_group > 2) | (model.geom_rgba[:, 3] == 0.0)
    named = below[model.geom_bodyid] | np.isin(geoms, list(hide))
    return set(np.flatnonzero(clear | named).tolist())


def _grey(model: mujoco.MjModel, geom: int) -> float:
    """Returns a geom's own grey, 0 to 1: of its color, and of its texture on the whole."""
    material = model.geom_matid[geom]
    if material < 0:
        return model.geom_rgba[geom, :3] @ GREY
    color, texture = model.mat_rgba[material, :3], model.mat_texid[material].max()
    if texture >= 0 and model.tex_nchannel[texture] >= 3:
        channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
        number = model.tex_height[texture] * model.tex_width[texture] * channels
        pixels = model.tex_data[start : start + number].reshape(-1, channels)
        color = color * pixels[:, :3].mean(0) / 255.0
    return color @ GREY


def _axes(quat: np.ndarray) -> np.ndarray:
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, quat)
    return axes.reshape(3, 3)


def _times(x: Array, y: Array) -> Array:
    """Returns matrices [..., 3, 3] times [..., 3, K]: sums, since a GPU may round a product's."""
    return sum(x[..., :, k, None] * y[..., None, k, :] for k in range(3))  # type: ignore[return-value]


def in_frame(
    shapes: Shapes,
    xpos: Array,
    xmat: Array,
    boxes: tuple[Array, Array] | None,
    position: Array,
    axes: Array,
) -> Seen:
    """Returns shapes, and this episode's boxes after them, in the frame of an eye.

    Args:
      shapes: S of them.
      xpos: of bodies [nbody, 3] [m].
      xmat: of bodies [nbody, 3, 3].
      boxes: centers and half sizes [P, 3] each [m], or None.
      position: of the eye [3] [m].
      axes: its own, [3, 3].
    """
    turn, place = xmat[shapes.body], xpos[shapes.body]
    place = place + _times(turn, shapes.position[:, :, None])[:, :, 0]
    turn = _times(turn, shapes.axes)
    parts = shapes.scale, shapes.length, shapes.radius, shapes.grey, shapes.body == 0
    if boxes is not None:
        centers, halves = boxes
        size = jnp.sqrt(jnp.square(halves).sum(1))
        place = jnp.concatenate([place, centers])
        turn = jnp.concatenate([turn, jnp.broadcast_to(jnp.eye(3), (len(centers), 3, 3))])
        more = halves, jnp.zeros_like(size), size, jnp.full_like(size, BOX_GREY), size > 0.0
        parts = tuple(jnp.concatenate(two) for two in zip(parts, more, strict=True))
    scale, length, radius, grey, still = map(jnp.asarray, parts)
    own = jnp.swapaxes(turn, 1, 2)
    return Seen(
        turn=_times(own, axes) / scale[:, :, None],
        origin=_times(own, (position - place)[:, :, None])[:, :, 0] / scale,
        light=_times(own, LIGHT[:, None])[:, :, 0],
        scale=scale,
        length=length,
        radius=radius,
        center=_times(axes.T, (place - position)[:, :, None])[:, :, 0],
        grey=grey,
        checked=still,
    )


def in_view(seen: Seen, rays: np.ndarray, reach: float) -> Array:
    """Tells which shapes' bounding spheres are within the pyramid of an eye's rays, [S] bool."""
    ahead, inside = -seen.center[:, 2], seen.radius
    visible = (ahead > -inside) & (ahead - inside < reach)
    for k, half in enumerate(np.abs(rays).max(axis=1)):
        outside = jnp.abs(seen.center[:, k]) - half * ahead
        visible &= outside <= 1.0001 * inside * np.sqrt(1.0 + half * half)
    return visible


def nearest(seen: Seen, visible: Array, kinds: np.ndarray, rays: np.ndarray) -> tuple[Array, Array]:
    """Returns where each ray enters its first shape, [N] (in units of the ray), and which that is.

    Args:
      seen: S shapes.
      visible: [S] bool: which to try.
      kinds: [S] indices in KINDS, ascending.
      rays: [2, N].
    """
    found = jnp.full(rays.shape[1], jnp.inf), jnp.zeros(rays.shape[1], jnp.int32)
    for number, kind in enumerate(KINDS.values()):
        first, last = np.searchsorted(kinds, [number, number + 1])
        if first < last:
            todo = visible & (kinds == number)
            found = _nearest_of(kind, todo, seen, rays, found)
    return found


def _nearest_of(
    kind: Kind, todo: Array, seen: Seen, rays: np.ndarray, found: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Tries the shapes of one kind that are to do, [S] bool, one after another, by number."""

    def go_on(carry: tuple) -> Array:
        return carry[0].any()

    def try_one(carry: tuple) -> tuple:
        todo, t, which = carry
        i = jnp.argmax(todo)
        d = _into(seen.turn[i], rays)
        entry = kind.enter(seen.origin[i], d, seen.length[i])
        nearer = entry < t
        todo = todo & (jnp.arange(todo.shape[0]) != i)
        return todo, jnp.where(nearer, entry, t), jnp.where(nearer, i.astype(jnp.int32), which)

    return jax.lax.while_loop(go_on, try_one, (todo, *found))[1:]


def _into(turn: Array, rays: np.ndarray) -> list[Array]:
    """Returns the rays' directions (right, up, 1 m ahead), [N] each, turned by [..., 3, 3]."""
    return [
        turn[..., k, 0] * rays[0] + turn[..., k, 1] * rays[1] - turn[..., k, 2] for k in range(3)
    ]


def lit(
    t: Array, which: Array, seen: Seen, kinds: np.ndarray, rays: np.ndarray
) -> tuple[Array, Array]:
    """Returns how directly light falls where each ray enters, and the ray itself, [N] 0 to 1 each.

    Args:
      t: [N] of the entries.
      which: [N] the shapes.
      seen: S shapes.
      kinds: [S] indices in KINDS.
      rays: [2, N].
    """
    turn, scale = seen.turn[which], seen.scale[which]
    ray = jnp.stack(_into(turn, rays), axis=1)
    point = seen.origin[which] + t[:, None] * ray
    length, kind, normal = seen.length[which], jnp.asarray(kinds)[which], point
    for number, one in enumerate(KINDS.values()):
        if (kinds == number).any():
            normal = jnp.where((kind == number)[:, None], one.normal(point, length), normal)
    normal, ray = _unit(normal / scale), _unit(ray * scale)  # of stretched surfaces
    light = jnp.maximum((normal * seen.light[which]).sum(-1), 0.0)
    return light, jnp.abs((normal * ray).sum(-1))


def _unit(x: Array) -> Array:
    """Returns vectors [..., 3] of length 1."""
    return x * jax.lax.rsqrt(jnp.square(x).sum(-1, keepdims=True) + 1e-20)
