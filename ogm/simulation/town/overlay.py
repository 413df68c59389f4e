"""What overlays of shapes give, without the lines and points that are left where two of them only touch."""

import shapely
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry


def polygons(shape: BaseGeometry) -> list[Polygon]:
    """Return the polygons of a geometry, largest first."""
    parts = [part for part in shapely.get_parts(shape) if isinstance(part, Polygon) and part.area > 0]
    return sorted(parts, key=lambda part: -part.area)


def area(shape: BaseGeometry) -> BaseGeometry:
    """Return a geometry without the lines and points that an overlay leaves where shapes only touch.

    Overlays refuse such mixtures as operands.
    """
    return shapely.union_all(polygons(shape))


def inside(line: BaseGeometry, shape: BaseGeometry) -> list[LineString]:
    """Return the parts of a line within a shape, without points where the two only touch."""
    parts = shapely.get_parts(shapely.intersection(line, area(shape)))
    return [part for part in parts if isinstance(part, LineString)]
