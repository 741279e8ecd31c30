"""Draws the compared columns: the same clouds, pose and scale, moved aside, each coloured by its own errors."""

from dataclasses import replace

import numpy as np

from app.coloring import point_colors
from app.colors import NO_MATCH, Colors
from app.compare import ComparedColumn
from app.explorer import NO_FINDINGS
from app.picture import CloudPicture, ColumnPicture, Picture
from app.placing import EXTENT, GAP, Placed, rightward, view_of
from app.settings import ViewSettings


def draw_columns(
    picture: Picture, columns: tuple[ComparedColumn, ...], settings: ViewSettings, placed: Placed
) -> Picture:
    """The picture with `columns` in place of its clouds and lines.

    Args:
        picture: Of the pair itself; gives pose, points and sizes.
        columns: As far as they are known; those that are not are grey.
        settings: Of the page.
        placed: The clouds of the picture.
    """
    right = rightward(placed.up, placed.direction)
    # Overlaid whatever the layout: what stands side by side here are the columns.
    source = replace(picture.source, position=picture.overlaid_position)
    moved = placed.source_prepared @ source.rotation.T + source.position
    points = np.concatenate([moved, placed.target_prepared]) if settings.compare_pair else moved
    along, height = points @ right, points @ placed.up
    step = (along.max() - along.min() + GAP * EXTENT) * right
    middle = points.mean(axis=0)
    top = middle + ((along.max() + along.min()) / 2 - middle @ right) * right
    top = top + (height.max() + GAP * EXTENT / 2 - middle @ placed.up) * placed.up
    drawn = []
    for number, column in enumerate(columns):
        colors = _colors(picture, column, settings)
        moved_aside = number * step
        precision = column.info.precision
        text = column.info.label if precision is None else f"{column.info.label}: {100 * precision:.1f} %"
        if not column.info.is_ready:
            text += ": cannot be computed" if column.info.problem else ": computing"
        drawn.append(
            ColumnPicture(
                replace(source, colors=colors[0], position=source.position + moved_aside),
                _target(picture.target, colors[1], moved_aside) if settings.compare_pair else None,
                text,
                top + moved_aside,
            )
        )
    corners = np.concatenate([points, points + (len(columns) - 1) * step, [column.label_position for column in drawn]])
    return replace(
        picture,
        columns=tuple(drawn),
        view=view_of(placed, corners),
        scene=(*picture.scene, "columns", len(columns), settings.compare_pair),
    )


def _target(target: CloudPicture, colors: Colors, moved_aside: np.ndarray) -> CloudPicture:
    return replace(target, colors=colors, position=target.position + moved_aside)


def _colors(picture: Picture, column: ComparedColumn, settings: ViewSettings) -> tuple[Colors, Colors]:
    if column.analysis is None:
        source, target = (
            np.tile(np.asarray(NO_MATCH, dtype=np.uint8), (len(cloud.points), 1))
            for cloud in (picture.source, picture.target)
        )
        return source, target
    return point_colors(column.analysis, column.scores, replace(settings, coloring="error"), NO_FINDINGS)
