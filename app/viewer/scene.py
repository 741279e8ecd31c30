"""Puts pictures into viser, sending only what changed."""

import threading
from collections.abc import Callable

import numpy as np
import viser
import viser.transforms

from app.colors import line_colors
from app.overlays import NOTHING, Overlays
from app.picture import CloudPicture, Picture
from app.placing import FIELD_OF_VIEW, Floats, View

OVERLAY_PIXELS = 2.6
FLIGHT_STEPS = 8
FLIGHT_S = 0.3
_USUAL_ASPECT = 1.7
_FAR_AWAY = np.full((2, 3), 1e6, np.float32)


class SceneView:
    """The scene of one viser server, the same in every tab; cameras are each tab's own."""

    def __init__(self, server: viser.ViserServer, picture: Callable[[], Picture | None]) -> None:
        """Draw into `server` what `picture` gives at the time of `update`."""
        self._server = server
        self._picture = picture
        self._drawn: Picture | None = None
        self._clouds: dict[str, viser.PointCloudHandle] = {}
        self._lines: viser.LineSegmentsHandle | None = None
        self._labels: list[viser.LabelHandle] = []
        self._overlays: list[viser.SceneNodeHandle] = []
        self._superseded = threading.Event()
        """Of the last flight of the cameras: set when another begins."""
        self._lock = threading.Lock()
        server.initial_camera.fov = float(FIELD_OF_VIEW)
        _keep_shaders(server)
        server.on_client_connect(self._frame)

    def update(self) -> None:
        """Draw the current picture."""
        with self._lock:
            before, picture = self._drawn, self._picture()
            if picture is None or picture is before:
                return
            with self._server.atomic():
                for name in ("source", "target"):
                    cloud_before = None if before is None else getattr(before, name)
                    self._draw_cloud(name, getattr(picture, name), cloud_before, point_size=picture.point_size)
                    self._clouds[name].visible = not picture.columns
                self._draw_lines(picture, before)
                self._draw_columns(picture, before)
                self._draw_overlays(_overlays(picture), _overlays(before))
                moved = before is None or before.scene != picture.scene
                if moved:
                    self._set_first_view(picture.view)
            self._server.flush()
            self._drawn = picture
        if moved:
            self.reset_cameras()
        if picture.followed is not None and (before is None or before.followed != picture.followed):
            threading.Thread(target=self._fly_to, args=(picture,), name="flight", daemon=True).start()

    def clouds(self) -> dict[str, viser.PointCloudHandle]:
        """Handles of the clouds drawn so far, by name."""
        with self._lock:
            return dict(self._clouds)

    def reset_cameras(self) -> None:
        """Show the whole scene in every tab."""
        for client in self._server.get_clients().values():
            self._frame(client)

    def _draw_cloud(self, name: str, cloud: CloudPicture, before: CloudPicture | None, *, point_size: float) -> None:
        wxyz = viser.transforms.SO3.from_matrix(cloud.rotation).wxyz
        if before is None or before.points is not cloud.points:
            self._clouds[name] = self._server.scene.add_point_cloud(
                f"/{name}",
                cloud.points,
                cloud.colors,
                point_size=point_size,
                point_shape="circle",
                # The pixels of a point have exactly its colour, which the legend is compared with.
                point_shading="flat",
                precision="float32",
                wxyz=wxyz,
                position=cloud.position,
            )
            return
        handle = self._clouds[name]
        if before.colors is not cloud.colors and not np.array_equal(before.colors, cloud.colors):
            handle.colors = cloud.colors
        if not np.array_equal(before.rotation, cloud.rotation):
            handle.wxyz = wxyz
        if not np.array_equal(before.position, cloud.position):
            handle.position = cloud.position
        if handle.point_size != point_size:
            handle.point_size = point_size

    def _draw_lines(self, picture: Picture, before: Picture | None) -> None:
        if (
            before is not None
            and bool(before.columns) == bool(picture.columns)
            and np.array_equal(before.line_points, picture.line_points)
            and np.array_equal(before.line_colors, picture.line_colors)
            and before.line_pixels == picture.line_pixels
        ):
            return
        if not len(picture.line_points) or picture.columns:
            if self._lines is not None:
                self._lines.remove()
                self._lines = None
            return
        colors = np.repeat(line_colors(picture.line_colors)[:, None], 2, axis=1)
        if self._lines is not None and before is not None and len(before.line_points) == len(picture.line_points):
            self._lines.points, self._lines.colors = picture.line_points, colors
            self._lines.thickness = picture.line_pixels
            return
        self._lines = self._server.scene.add_line_segments(
            "/matches", picture.line_points, colors, thickness=picture.line_pixels, thickness_units="screen"
        )

    def _draw_columns(self, picture: Picture, before: Picture | None) -> None:
        """The compared clouds, with a label above each."""
        were = _column_clouds(before)
        now = _column_clouds(picture)
        for name in were.keys() - now.keys():
            self._clouds.pop(name).remove()
        for name, cloud in now.items():
            self._draw_cloud(name, cloud, were.get(name), point_size=picture.point_size)
        texts = [(column.label, *column.label_position.tolist()) for column in picture.columns]
        if texts == [(label.text, *label.position) for label in self._labels]:
            return
        for label in self._labels:
            label.remove()
        self._labels = [
            self._server.scene.add_label(
                f"/column-{number}/label", column.label, position=column.label_position, anchor="bottom-center"
            )
            for number, column in enumerate(picture.columns)
        ]

    def _draw_overlays(self, overlays: Overlays, before: Overlays) -> None:
        if all(
            np.array_equal(getattr(before, name), getattr(overlays, name)) for name in overlays.__dataclass_fields__
        ):
            return
        for node in self._overlays:
            node.remove()
        self._overlays = []
        if len(overlays.marker_points):
            self._overlays.append(
                self._server.scene.add_point_cloud(
                    "/picked/points",
                    overlays.marker_points,
                    overlays.marker_colors,
                    point_size=overlays.marker_size,
                    point_shape="circle",
                    point_shading="flat",
                    precision="float32",
                )
            )
        if len(overlays.line_points):
            colors = np.repeat(line_colors(overlays.line_colors)[:, None], 2, axis=1)
            self._overlays.append(
                self._server.scene.add_line_segments(
                    "/picked/lines", overlays.line_points, colors, thickness=OVERLAY_PIXELS, thickness_units="screen"
                )
            )
        for number, (text, place) in enumerate(zip(overlays.label_texts, overlays.label_points, strict=True)):
            # Never hidden, unlike the markers.
            self._overlays.append(
                self._server.scene.add_label(
                    f"/picked/label-{number}", text, position=place, font_screen_scale=0.8, anchor="bottom-center"
                )
            )

    def _set_first_view(self, view: View) -> None:
        """Where tabs start that are opened from now on."""
        self._server.scene.set_up_direction(view.up)
        camera = self._server.initial_camera
        camera.up = view.up
        camera.position, camera.look_at = view.camera(_USUAL_ASPECT)

    def _frame(self, client: viser.ClientHandle) -> None:
        """Show the whole scene in one tab, whatever the shape of its window."""
        picture = self._drawn
        if picture is None:
            return
        camera = client.camera
        aspect = camera.image_width / max(camera.image_height, 1)
        view = picture.view
        camera.up_direction = view.up
        _aim(client, *view.camera(aspect if aspect > 0 else 1.0))

    def _fly_to(self, picture: Picture) -> None:
        """Bring the focus of the overlays into sight in every tab, along the direction in which it looks already."""
        with self._lock:
            self._superseded.set()
            superseded = self._superseded = threading.Event()
        routes = []
        for client in self._server.get_clients().values():
            camera = client.camera
            before = np.asarray(camera.position), np.asarray(camera.look_at)
            away = before[0] - before[1]
            direction = away / max(float(np.linalg.norm(away)), 1e-9)
            aspect = camera.image_width / max(camera.image_height, 1)
            view = View(direction, picture.view.up, picture.overlays.focus)
            routes.append((client, before, view.camera(aspect if aspect > 0 else 1.0)))
        for step in range(1, FLIGHT_STEPS + 1):
            share = step / FLIGHT_STEPS
            eased = share * share * (3 - 2 * share)
            for client, before, after in routes:
                position, look_at = ((1 - eased) * a + eased * b for a, b in zip(before, after, strict=True))
                _aim(client, position, look_at)
            if superseded.wait(FLIGHT_S / FLIGHT_STEPS):
                return


def _keep_shaders(server: viser.ViserServer) -> None:
    """Draw a cloud and a line too far away to be seen.

    With new colours, or another number of lines, viser's client makes a new material, and drops the last one first:
    unless something else holds their shader, it is compiled again, which takes longer than to draw.
    """
    colors = np.zeros((2, 3), np.uint8)
    server.scene.add_point_cloud(
        "/keeps-shader/points", _FAR_AWAY, colors, point_shape="circle", point_shading="flat", precision="float32"
    )
    server.scene.add_line_segments(
        "/keeps-shader/lines", _FAR_AWAY[None], colors[None], thickness=1.0, thickness_units="screen"
    )


def _overlays(picture: Picture | None) -> Overlays:
    """What is drawn over the clouds; nothing where others are compared in their place."""
    return NOTHING if picture is None or picture.columns else picture.overlays


def _aim(client: viser.ClientHandle, position: Floats, look_at: Floats) -> None:
    with client.atomic():
        # Moving the camera takes its target along, so the target comes last.
        client.camera.position = position
        client.camera.look_at = look_at
    client.flush()


def _column_clouds(picture: Picture | None) -> dict[str, CloudPicture]:
    """The clouds of all columns by the name of their node."""
    clouds = {}
    for number, column in enumerate(() if picture is None else picture.columns):
        clouds[f"column-{number}/source"] = column.source
        if column.target is not None:
            clouds[f"column-{number}/target"] = column.target
    return clouds
