"""The body in the browser's three dimensions, by viser; with `page.py` all that draws.

The camera stands where a person puts it. While it follows the body, the world is moved under it
instead, so that a person can turn the camera meanwhile, and one message a frame is enough.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from purerl.report.renderer import Stage
from purerl.tune.view import session as events, shapes
from purerl.tune.view.session import Session

WORLD = "/world"
GROUND_COLOR = (225, 230, 235)


class Scene:
    """The drawn model of one program."""

    def __init__(self, server: viser.ViserServer, put: Callable[..., None]) -> None:
        """Prepares an empty scene; what the mouse does to the body becomes events, given to put."""
        self.server, self.put = server, put
        self.follows, self.offset = True, np.zeros(3)
        self.world: Any = None
        self.seen: Any = None  # the picture that is drawn

    def show(self, session: Session) -> None:
        """Draws a program's model anew; the camera stands as it did, if there was one."""
        first = self.world is None
        if not first:
            self.world.remove()  # with all below it
        self.world = self.server.scene.add_frame(WORLD, show_axes=False)
        self.stage = Stage(session.program.env.physics.model)
        self.model, self.data = model, _ = self.stage.model, self.stage.data
        self.stage.pose(session.picture)
        self.batches = shapes.batches(model)
        if session.picture.ghost:
            self.batches |= shapes.ghosts(self.batches)
        self.drawn = {name: self._layout(name) for name in self.batches}
        self.handles = {name: self._add_batch(name) for name in self.batches}
        for plane in shapes.planes(model):
            self.server.scene.add_grid(
                f"{WORLD}/plane{plane}", 400.0, 400.0, position=self.data.geom_xpos[plane],
                wxyz=self.data.xquat[model.geom_bodyid[plane]], cell_size=0.5,
                plane_color=GROUND_COLOR, plane_opacity=1.0, fade_distance=60.0,
            )  # fmt: skip
        self.scenery: shapes.Layout | None = None
        self.boxes: Any = None
        if first:
            self._aim()
        self.seen = None
        self.draw(session)

    def draw(self, session: Session) -> None:
        """Moves everything to where it is in the session's picture."""
        if session.picture is self.seen:
            return
        self.seen = session.picture
        self.stage.pose(session.picture)
        with self.server.atomic():
            for name in self.batches:
                where = self._layout(name)
                _send(self.handles[name], self.drawn[name], where)
                self.drawn[name] = where
            self._draw_scenery(shapes.scenery_layout(session.picture))
            if self.follows:
                self.offset = np.append(self.data.subtree_com[self.stage.root][:2], 0.0)
                self.world.position = -self.offset

    def _layout(self, name: str) -> shapes.Layout:
        data = self.stage.ghost if name.startswith(shapes.GHOST) else self.data
        return shapes.layout(self.model, data, self.batches[name])

    def _add_batch(self, name: str) -> Any:
        batch, where = self.batches[name], self.drawn[name]
        faint = bool((batch.opacities < 1).any())
        handle = self.server.scene.add_batched_meshes_simple(
            f"{WORLD}/{name}", batch.mesh.vertices, batch.mesh.faces, where.wxyzs,
            where.positions, batched_scales=where.scales,
            batched_colors=shapes.as_light(batch.colors),
            batched_opacities=batch.opacities if faint else None, lod="off",
        )  # fmt: skip
        if batch.moving:
            # Async, so that viser keeps the order of a drag's events.
            @handle.on_drag("left")
            async def _(event: Any) -> None:
                self._dragged(batch, event)

        return handle

    def _dragged(self, batch: shapes.Batch, event: Any) -> None:
        """Tells that the mouse draws at a part of a body, or lets it go."""
        if event.phase == "end":
            self.put(events.change, "grip", None)
            return
        start, end = (np.array(p) + self.offset for p in (event.start_position, event.end_position))
        geom = batch.geoms[(event.instance_index or 0) % len(batch.geoms)]
        self.put(events.pull, int(self.model.geom_bodyid[geom]), start, end)

    def _draw_scenery(self, where: shapes.Layout | None) -> None:
        """Draws an episode's boxes, which stand still: they are sent once."""
        before = self.scenery
        if before is where or (before and where and np.array_equal(before[0], where[0])):
            return
        self.scenery = where
        if self.boxes is not None:
            self.boxes.remove()
        self.boxes = None
        if where is not None:
            box = shapes.UNIT_MESHES[shapes.BOX]
            self.boxes = self.server.scene.add_batched_meshes_simple(
                f"{WORLD}/scenery", box.vertices, box.faces, where.wxyzs, where.positions,
                batched_scales=where.scales, lod="off",
                batched_colors=shapes.as_light(shapes.SCENERY_COLOR),
            )  # fmt: skip

    def _aim(self) -> None:
        """Sets the camera that a browser begins with: from the side, as far as the body is big."""
        radius = self.stage.radius(0.05)
        camera = self.server.initial_camera
        height = float(self.data.subtree_com[self.stage.root][2])
        camera.look_at = (0.0, 0.0, height)
        camera.position = (-0.6 * radius, -2.4 * radius, height + 0.9 * radius)
        camera.near = radius / 100


def _send(handle: Any, before: shapes.Layout, now: shapes.Layout) -> None:
    """Sends what has changed of a batch."""
    for field, old, new in zip(("positions", "wxyzs", "scales"), before, now, strict=True):
        if not np.array_equal(old, new):
            setattr(handle, f"batched_{field}", new)
