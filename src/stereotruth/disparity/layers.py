"""The arrays of a disparity store and what their attributes say."""

from __future__ import annotations

import numpy as np

from ..products.grids import Layer
from .settings import Settings
from .status import Status


def layers(settings: Settings, view: str, masked: bool = False) -> dict[str, Layer]:
    """The arrays of a disparity store of the ``view``, left or right.

    ``masked``: whether a mask hides something of an image.
    """
    statuses = [*settings.statuses, *([Status.MASKED] if masked else [])]
    other = {"left": "right", "right": "left"}[view]
    match = {"left": "x - disparity", "right": "x + disparity"}[view]
    condensed = "disparity of the point at mean longitude and latitude, greatest height"
    used = "points whose image windows correlate"
    compared = "mean correlation coefficient of the image windows at the points used"
    between, lonely, rough = {}, {}, {}
    if settings.on_surface:
        condensed = (
            "disparity at the pixel's centre, by a plane through the mean points of the pixel and "
            "of its neighbours on the same surface"
        )
        used = "points on the surface that the pixel's centre sees"
        compared = (
            f"correlation coefficient of {view} and warped {other} image over the pixels of "
            f"the same surface in {settings.window} x {settings.window} px"
        )
        between = {
            "between": "where the status is labelled_between, or a point is less sure than those "
            "around it: linear in the triangle of points that the pixel's centre sees; where it is "
            "labelled_crown: linear in the triangle of the tops of a rough surface"
        }
        lonely = {
            "labelled_crown": "a rough surface that both views must show; its uncertainty follows "
            "from the roughness of its points",
            "edge_in_pixel": "no smooth triangle of points, or a step between points may be "
            "nearer to one of the cameras",
        }
        rough = {
            "labelled_crown": "v / n + p is what the roughness of the tops of the surface leaves "
            "between them"
        }
    hidden = {}
    if masked:
        hidden = {
            "masked": f"a mask hides the pixel, or what the {other} image shows of it; or a mask "
            "reaches into the windows that are compared around it"
        }
    return {
        "disparity": Layer(
            "float32",
            np.nan,
            {
                "units": "px",
                "long_name": f"ground-truth disparity x_left - x_right of the {view} view",
                "nodata": "NaN",
                "match": f"what the {view} image shows at (x, y), the {other} one shows at "
                f"({match}, y)",
                "representative": condensed,
            }
            | between,
        ),
        "status": Layer(
            "uint8",
            0,
            {
                "units": "1",
                "long_name": "why a pixel has a label or none",
                "flag_values": [int(status) for status in statuses],
                "flag_meanings": " ".join(status.name.lower() for status in statuses),
                f"hidden_in_{view}": "no point of the pixel lies on the surface that its centre "
                "sees",
                "changed": "LiDAR and images show different surfaces there, or water",
                "edge_in_pixel": "an edge passes near the centre, or most neighbours carry other "
                "surfaces",
                "precedence": f"frame, {view} view, correlation of points; {other} view, edge, "
                "change, number of points of pixels",
            }
            | lonely
            | hidden,
        ),
        "height": Layer(
            "float32",
            np.nan,
            {
                "units": "m",
                "long_name": "greatest height above the WGS 84 ellipsoid of the points used",
                "nodata": "NaN",
            },
        ),
        "point_count": Layer(
            "uint16",
            0,
            {
                "units": "1",
                "long_name": f"number of points used: {used}",
                "comment": "counts above 65535 are stored as 65535",
            },
        ),
        "correlation": Layer(
            "float32",
            np.nan,
            {
                "units": "1",
                "long_name": compared,
                "nodata": "NaN",
            },
        ),
        "uncertainty": Layer(
            "float32",
            np.nan,
            {
                "units": "px",
                "long_name": "standard uncertainty of the disparity",
                "nodata": "NaN",
                "formula": "sqrt(v / n + p + var(ed - gx ex - gy ey)): v variance of the points' "
                "disparities about their surface, pooled over 3 x 3 pixels; n point_count; p "
                "variance of the plane to the centre; (gx, gy) slope of the disparity; ed, (ex, ey)"
                " errors of a ground point's disparity and place by the alignment, whose "
                "covariance is that of alignment.json",
            }
            | rough,
        ),
        "surface_class": Layer(
            "uint8",
            0,
            {
                "units": "1",
                "long_name": "LAS class (ASPRS) of the highest point used",
                "comment": "0: never classified, or no label",
            },
        ),
    }
