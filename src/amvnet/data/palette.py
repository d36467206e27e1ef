"""The colours of classes and of marked points: in files of points, in the viewer and in charts.

Some official colours look alike in a picture, or cannot be seen on a dark background.
"""

from __future__ import annotations

from amvnet.data.taxonomy import Color, Taxonomy

UNLABELLED: Color = (128, 136, 148)  # officially black
WRONG: Color = (255, 64, 54)
UNCERTAIN: Color = (255, 150, 180)  # no class of either benchmark has a similar colour

# Colours that replace official colours, where these look like the colours of other classes.
DRAWN: dict[str, dict[str, Color]] = {
    "semantickitti": {
        "sidewalk": (150, 90, 150),
        "other-ground": (75, 150, 90),
        "traffic-sign": (135, 150, 0),
    },
    "nuscenes": {
        "sidewalk": (150, 90, 150),
        "motorcycle": (255, 30, 225),
        "trailer": (0, 135, 255),
        "truck": (225, 150, 255),
    },
}


def class_colors(taxonomy: Taxonomy) -> tuple[Color, ...]:
    """Return the K + 1 colours of the classes, RGB in 0..255, by train id."""
    drawn = DRAWN.get(taxonomy.name, {})
    colors = [UNLABELLED]
    for name, color in zip(taxonomy.classes, taxonomy.colors[1:], strict=True):
        colors.append(drawn.get(name, color))
    return tuple(colors)
