"""Bodies: materials, ropes, cloths, meshes, garments, outlines."""

import pickle
from typing import Any

import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from jaxsimp.bodies import (
    MATERIALS,
    clean_mesh,
    mesh_outline,
    mesh_symmetric_outline,
    remesh,
)
from tests.fuzz.core import Door, Parameter
from tests.fuzz.meshes import disc, grid, is_sheet, mesh_points
from tests.fuzz.valid import (
    LARGEST,
    SMALLEST,
    as_floats,
    both,
    extent,
    in_range,
    is_array,
    is_count,
    is_number,
    is_size,
)
from tests.fuzz.values import (
    anything,
    array,
    between,
    count,
    normal,
    number,
    value_of,
)

PHYSICS = {
    "density": ((1e-3, 10.0), (1e-9, 1e6)),
    "stretch_stiffness": ((0.0, 1e4), (0.0, 1e12)),
    "shear_stiffness": ((0.0, 1e4), (0.0, 1e12)),
    "bend_stiffness": ((0.0, 1e4), (0.0, 1e12)),
    "damping": ((0.0, 10.0), (0.0, 1e12)),
    "drag": ((0.0, 100.0), (0.0, 1e12)),
    "friction": ((0.0, 5.0), (0.0, 1e12)),
    "thickness": ((0.0, 0.05), (0.0, 10.0)),
}
"""Parameters of a material: what is valid for sure, and what is refused beyond."""
MASS = ((1e-4, 10.0), (1e-9, 1e6))
"""The same for the mass of a body, kilograms."""
WHOLE = js.rope(5)
"""A body to take apart."""
ARRAYS = ("rest", "mass", "springs", "families", "rest_length", "stiffness", "damping", "faces")
"""Its arrays."""


def is_physics(**values: Any) -> bool | None:
    """Whether parameters of a material are valid."""
    return both(
        *(
            in_range(value, *PHYSICS[name][0], absurd=PHYSICS[name][1])
            for name, value in values.items()
        )
    )


def is_mass(mass: Any) -> bool | None:
    """Whether a mass is valid; None is the default."""
    return True if mass is None else in_range(mass, *MASS[0], absurd=MASS[1])


def is_material(material: Any) -> bool | None:
    """Whether a value is a material; None is the default."""
    return material is None or isinstance(material, js.Material)


def is_length(value: Any) -> bool | None:
    """Whether a number is a length that a body may have."""
    known = is_number(value)
    return False if known is False else both(known, is_size(float(value)))


def physics(*names: str) -> dict[str, Parameter]:
    """Parameters of a material, as optional arguments."""
    return {name: number(*PHYSICS[name][0]) for name in names}


def is_fine_body(body: js.Body) -> None:
    """Check what every body promises."""
    for name in ("rest", "mass", "springs", "rest_length", "stiffness", "damping", "faces"):
        own = getattr(body, name)
        assert np.isfinite(own).all(), f"{name} is not finite"
        assert not own.flags.writeable, f"{name} is writable"
        assert type(own) is np.ndarray, f"{name} is a {type(own).__name__}"
    assert (body.mass > 0).all(), "a mass is not above zero"
    assert abs(body.rest[:, 2].min()) < 1e-9, "the lowest point is not at z = 0"
    assert SMALLEST * 0.99 <= body.size <= LARGEST * 1.01, f"the body is {body.size:g} m large"
    again = pickle.loads(pickle.dumps(body))
    assert np.array_equal(again.rest, body.rest), "a copy by pickle differs"
    assert not again.rest.flags.writeable, "a copy by pickle is writable"


def _total_mass(body: js.Body, extent: float, mass: Any, density: Any) -> None:
    if mass is not None:
        wanted = float(mass)
        assert np.isclose(body.mass.sum(), wanted), f"the mass is {body.mass.sum():g}"
    elif density is not None:
        wanted = float(density) * extent
        assert np.isclose(body.mass.sum(), wanted), f"the mass is {body.mass.sum():g}"


def _is_rope(
    num_particles: Any = 41,
    length: Any = 0.5,
    mass: Any = None,
    material: Any = None,
    **changes: Any,
) -> bool | None:
    known = set(changes) <= set(PHYSICS)
    shear = changes.get("shear_stiffness", 0.0)
    return known and both(
        is_count(num_particles, 2, 200),
        is_length(length),
        is_mass(mass),
        is_material(material),
        is_physics(**changes),
        not (mass is not None and "density" in changes),
        is_number(shear) is False or float(shear) == 0,
    )


def _check_rope(
    body: js.Body,
    num_particles: Any = 41,
    length: Any = 0.5,
    mass: Any = None,
    material: Any = None,
    **changes: Any,
) -> None:
    is_fine_body(body)
    assert body.num_particles == int(num_particles), "another number of particles"
    assert np.isclose(body.size, float(length)), f"the rope is {body.size:g} m long"
    _total_mass(body, float(length), mass, changes.get("density"))


def _is_rope_along(points: Any, mass: Any = None, material: Any = None, **changes: Any) -> Any:
    shape = is_array(points, (None, 3))
    if shape is False or len(points) < 2:
        return False
    rows = as_floats(points)
    # A spring joins each particle to the next and to the one after it: none may have no length.
    ends = [rows[1:] - rows[:-1], rows[2:] - rows[:-2]]
    steps = np.linalg.norm(np.concatenate(ends), axis=1)
    others = _is_rope(mass=mass, material=material, **changes)
    return both(shape, bool((steps > 0).all()), is_size(extent(points)), others)


def _check_rope_along(body: js.Body, points: Any, mass: Any = None, **changes: Any) -> None:
    is_fine_body(body)
    wanted = as_floats(points)
    moved = wanted - wanted[0] + body.rest[0]
    assert np.allclose(moved, body.rest, atol=1e-9), "the rope is not along the points"


def _is_cloth(
    shape: Any = (25, 25),
    size: Any = (0.3, 0.3),
    mass: Any = None,
    material: Any = None,
    **changes: Any,
) -> bool | None:
    if not all(isinstance(pair, tuple | list | np.ndarray) for pair in (shape, size)):
        return False
    if any(isinstance(pair, np.ndarray) and pair.ndim == 0 for pair in (shape, size)):
        return False
    if len(shape) != 2 or len(size) != 2:
        return False
    known = set(changes) <= set(PHYSICS)
    counts = [is_count(each, 2, 60) for each in shape]
    sides = [in_range(each, SMALLEST * 1.001, 4.9, absurd=(1e-5, 5.001)) for each in size]
    is_tuple = True if isinstance(shape, tuple) and isinstance(size, tuple) else None
    return known and both(
        *counts,
        *sides,
        is_tuple,
        is_mass(mass),
        is_material(material),
        is_physics(**changes),
        not (mass is not None and "density" in changes),
    )


def _check_cloth(
    body: js.Body,
    shape: Any = (25, 25),
    size: Any = (0.3, 0.3),
    mass: Any = None,
    material: Any = None,
    **changes: Any,
) -> None:
    is_fine_body(body)
    sides = [float(each) for each in size]
    assert body.num_particles == int(shape[0]) * int(shape[1]), "another number of particles"
    assert np.allclose(np.ptp(body.rest[:, :2], axis=0), sides), "another size"
    assert len(body.faces) == 2 * (int(shape[0]) - 1) * (int(shape[1]) - 1), "other triangles"
    _total_mass(body, sides[0] * sides[1], mass, changes.get("density"))


def _is_mesh(points: Any, faces: Any, scale: Any = 1.0, name: Any = "mesh", **changes: Any) -> Any:
    by = in_range(scale, 1e-4, 1e4, absurd=(1e-12, 1e12))
    if by is False or not isinstance(name, str) or not set(changes) <= set(PHYSICS):
        return False
    shear = changes.get("shear_stiffness", 0.0)
    return both(
        by,
        is_sheet(points, faces, float(scale)),
        is_physics(**changes),
        is_number(shear) is False or float(shear) == 0,
    )


def _check_mesh(body: js.Body, points: Any, faces: Any, scale: Any = 1.0, **changes: Any) -> None:
    is_fine_body(body)
    used = float(scale) * as_floats(points)[np.unique(np.asarray(faces))]
    assert np.isclose(np.ptp(used, axis=0).max(), body.size, rtol=1e-3), "another size"
    order = np.random.default_rng(0).permutation(len(points))
    where = np.argsort(order)
    again = js.from_mesh(as_floats(points)[order], where[np.asarray(faces)], scale=float(scale))
    assert again.num_particles == body.num_particles, "another order gives other particles"
    assert np.isclose(
        again.mass.sum() / again.material.density, body.mass.sum() / body.material.density
    ), "another order gives another mass"


def _check_clean(result: Any, points: Any, faces: Any, scale: Any = 1.0) -> None:
    cleaned, ids = result
    assert np.isfinite(cleaned).all(), "a point is not finite"
    assert ids.min() >= 0, "an id is below zero"
    assert ids.max() < len(cleaned), "an id is too large"
    again = clean_mesh(cleaned, ids)
    assert np.array_equal(again[0], cleaned), "a clean mesh changes when cleaned again"
    assert np.array_equal(again[1], ids), "the triangles of a clean mesh change"


def _is_body(**arrays: Any) -> bool | None:
    given = {**_parts(), **arrays}
    number_of, springs = len(WHOLE.rest), len(WHOLE.springs)
    shapes = {
        "rest": ((number_of, 3), "f"),
        "mass": ((number_of,), "f"),
        "springs": ((springs, 2), "i"),
        "families": ((springs,), "i"),
        "rest_length": ((springs,), "f"),
        "stiffness": ((springs,), "f"),
        "damping": ((springs,), "f"),
        "faces": ((0, 3), "i"),
    }
    verdicts = [is_array(given[name], *shape) for name, shape in shapes.items()]
    if False in verdicts:
        return False
    values = {name: as_floats(given[name]) for name in shapes}
    pairs = np.sort(values["springs"], axis=1)
    fine = (
        is_size(extent(values["rest"])) is not False
        and (values["mass"] > 1e-9).all()
        and (values["mass"] < 1e6).all()
        and (values["rest_length"] > 0).all()
        and (values["stiffness"] >= 0).all()
        and (values["damping"] >= 0).all()
        and (pairs >= 0).all()
        and (pairs < number_of).all()
        and (pairs == pairs.astype(int)).all()
        and (pairs[:, 0] != pairs[:, 1]).all()
        and len(np.unique(pairs, axis=0)) == springs
        and np.isin(values["families"], (0, 1, 2)).all()
    )
    changed = [name for name in shapes if not np.array_equal(values[name], _parts()[name])]
    return both(*verdicts, bool(fine), None if changed else True, isinstance(given["name"], str))


def _parts() -> dict[str, Any]:
    return {name: getattr(WHOLE, name) for name in js.Body.__dataclass_fields__}


def _make_body(**arrays: Any) -> tuple[js.Body, dict[str, bool]]:
    given = {**_parts(), **arrays}
    own = {name: each for name, each in given.items() if isinstance(each, np.ndarray)}
    before = {name: each.flags.writeable for name, each in own.items()}
    body = js.Body(**given)
    after = {name: each.flags.writeable == before[name] for name, each in own.items()}
    return body, after


def _check_body(result: Any, **arrays: Any) -> None:
    body, same = result
    assert all(same.values()), "the caller's own array was made read-only"
    for name in ("rest", "mass", "springs", "stiffness"):
        assert not getattr(body, name).flags.writeable, f"{name} is writable"
        assert np.isfinite(getattr(body, name)).all(), f"{name} is not finite"


def _is_scaled(**factors: Any) -> bool | None:
    return both(*(in_range(each, 0.1, 10.0, absurd=(0.0, 1e9)) for each in factors.values()))


def _check_scaled(body: js.Body, **factors: Any) -> None:
    is_fine_body(body)
    factor = float(factors.get("mass", 1.0))
    assert np.allclose(body.mass, factor * WHOLE.mass), "another mass"


GARMENTS = {
    "towel": {"length": (0.2, 1.0), "width": (0.2, 1.0)},
    "t_shirt": {
        "length": (0.4, 0.6),
        "chest": (0.3, 0.4),
        "sleeve_length": (0.12, 0.2),
        "sleeve_width": (0.1, 0.14),
        "neck_width": (0.1, 0.16),
        "neck_depth": (0.03, 0.07),
        "slope": (10.0, 25.0),
    },
    "trousers": {
        "length": (0.5, 0.8),
        "waist": (0.26, 0.32),
        "rise": (0.15, 0.25),
        "cuff": (0.1, 0.14),
        "spread": (0.03, 0.08),
    },
    "skirt": {"length": (0.3, 0.5), "waist": (0.2, 0.3), "hem": (0.35, 0.5)},
}
"""Dimensions of garments that fit each other."""


def _is_garment(ranges: dict[str, tuple[float, float]]) -> Any:
    def is_valid(num_particles: Any = 600, sheets: Any = 1, **given: Any) -> bool | None:
        sizes = [
            in_range(given[name], *ranges[name], absurd=(-10.0 if name == "spread" else 0.0, 60.0))
            for name in given
            if name in ranges
        ]
        others = {name: each for name, each in given.items() if name in PHYSICS}
        one_or_two = is_count(sheets, 1, 2, most=2)
        # How many particles an outline needs is not documented.
        particles = is_count(num_particles, 150, 400, least=3, most=10**7)
        return both(*sizes, particles, one_or_two, is_physics(**others))

    return is_valid


def _check_garment(garment: js.Garment, num_particles: Any = 600, **_: Any) -> None:
    body = garment.body
    is_fine_body(body)
    assert abs(body.num_particles - int(num_particles)) <= 0.1 * int(num_particles) + 1, (
        f"{body.num_particles} particles"
    )
    mirrored = body.rest[garment.mirror] * np.array([-1.0, 1.0, 1.0])
    assert np.allclose(mirrored, body.rest, atol=1e-9), "the mirror images are elsewhere"
    ids = np.array(list(garment.landmarks.values()))
    assert ((ids >= 0) & (ids < body.num_particles)).all(), "a landmark is no particle"


def _garment(name: str) -> Door:
    ranges = GARMENTS[name]
    sheets = {} if name == "towel" else {"sheets": count(1, 2)}
    return Door(
        f"bodies.{name}",
        getattr(js, name),
        {
            **{key: number(*each) for key, each in ranges.items()},
            "num_particles": count(150, 400, optional=False),
            **sheets,
            "density": number(0.05, 1.0),
        },
        _is_garment(ranges),
        _check_garment,
        weight=4,
    )


SQUARE = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.2], [0.0, 0.2]])
HALF = np.array([[0.0, 0.0], [0.2, 0.0], [0.25, -0.3], [0.0, -0.3]])


def _is_outline(corners: Any, num_points: Any) -> bool | None:
    shape = is_array(corners, (None, 2))
    if shape is False or len(corners) < 3:
        return False
    known = is_size(extent(corners)) if extent(corners) > 5.001 else None
    is_own = any(np.array_equal(corners, each) for each in (SQUARE, HALF))
    return both(
        shape, is_count(num_points, 60, 400, least=3, most=10**7), known, True if is_own else None
    )


def _check_outline(result: Any, num_points: Any, **_: Any) -> None:
    points, faces = result[:2]
    assert np.isfinite(points).all(), "a point is not finite"
    assert faces.max() < len(points), "an id is too large"
    assert abs(len(points) - int(num_points)) <= 0.1 * int(num_points) + 1, f"{len(points)} points"


def _is_remesh(points: Any, faces: Any, num_points: Any) -> bool | None:
    return both(
        is_sheet(points, faces, 1.0), is_count(num_points, 60, 400, least=3, most=10**7), None
    )


materials = st.sampled_from([None, *MATERIALS.values()])
material = Parameter(materials, anything)
rope_material = Parameter(st.sampled_from([None, MATERIALS["rope"], MATERIALS["mesh"]]), anything)
sizes = st.tuples(between(0.05, 2.0), between(0.05, 2.0))
shapes = st.tuples(st.integers(2, 12), st.integers(2, 12))
pairs = st.tuples(anything, anything) | st.tuples(st.just(7), anything) | anything


def _line(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.01, 0.05, (rng.integers(2, 12), 3)), axis=0)


DOORS = (
    Door(
        "bodies.Material",
        js.Material,
        {name: number(*PHYSICS[name][0], optional=name == "shear_stiffness") for name in PHYSICS},
        is_physics,
    ),
    Door(
        "bodies.Material.changed",
        MATERIALS["cloth"].changed,
        {**physics(*PHYSICS), "colour": Parameter(st.nothing() | st.just(1), anything)},
        lambda colour=0, **others: False if colour else is_physics(**others),
    ),
    Door(
        "bodies.rope",
        js.rope,
        {
            "num_particles": count(2, 60),
            "length": number(SMALLEST, LARGEST),
            "mass": number(*MASS[0]),
            "material": rope_material,
            **physics("stretch_stiffness", "bend_stiffness", "drag", "thickness", "density"),
        },
        _is_rope,
        _check_rope,
        weight=20,
    ),
    Door(
        "bodies.rope_along",
        js.rope_along,
        {
            "points": array(st.integers(0, 10**6).map(_line)),
            "mass": number(*MASS[0]),
            **physics("damping", "friction"),
        },
        _is_rope_along,
        _check_rope_along,
        weight=20,
    ),
    Door(
        "bodies.cloth",
        js.cloth,
        {
            "shape": Parameter(shapes, pairs),
            "size": Parameter(sizes, pairs),
            "mass": number(*MASS[0]),
            "material": material,
            **physics("shear_stiffness", "thickness", "density"),
        },
        _is_cloth,
        _check_cloth,
        weight=20,
    ),
    Door(
        "bodies.from_mesh",
        js.from_mesh,
        {
            "points": array(mesh_points),
            "faces": array(st.just(grid(4)[1])),
            "scale": number(0.5, 2.0),
            "name": value_of(st.sampled_from(("mesh", "sheet")), optional=True),
            **physics("density", "bend_stiffness"),
        },
        _is_mesh,
        _check_mesh,
        weight=20,
    ),
    Door(
        "bodies.clean_mesh",
        clean_mesh,
        {
            "points": array(mesh_points),
            "faces": array(st.just(grid(4)[1]) | st.just(grid(4)[1][::-1])),
            "scale": number(0.5, 2.0),
        },
        lambda points, faces, scale=1.0: both(
            in_range(scale, 1e-4, 1e4, absurd=(1e-12, 1e12)),
            False
            if in_range(scale, 1e-4, 1e4, absurd=(1e-12, 1e12)) is False
            else is_sheet(points, faces, float(scale)),
        ),
        _check_clean,
        weight=20,
    ),
    Door(
        "bodies.Body",
        _make_body,
        {name: array(st.sampled_from([getattr(WHOLE, name)]), optional=True) for name in ARRAYS},
        _is_body,
        _check_body,
        weight=20,
    ),
    Door(
        "bodies.Body.scaled",
        WHOLE.scaled,
        {
            name: number(0.1, 10.0)
            for name in ("mass", "stiffness", "damping", "drag", "friction", "thickness")
        },
        _is_scaled,
        _check_scaled,
    ),
    *map(_garment, GARMENTS),
    Door(
        "bodies.mesh_outline",
        mesh_outline,
        {
            "corners": array(st.sampled_from([SQUARE]) | normal((5, 2), 0.2)),
            "num_points": count(60, 400, optional=False),
        },
        _is_outline,
        _check_outline,
        weight=5,
    ),
    Door(
        "bodies.mesh_symmetric_outline",
        mesh_symmetric_outline,
        {
            "half": array(st.sampled_from([HALF])),
            "num_points": count(60, 400, optional=False),
        },
        lambda half, num_points: _is_outline(half, num_points),
        _check_outline,
        weight=5,
    ),
    Door(
        "bodies.remesh",
        remesh,
        {
            "points": array(st.sampled_from([disc()[0]])),
            "faces": array(st.sampled_from([disc()[1]])),
            "num_points": count(60, 400, optional=False),
        },
        _is_remesh,
        _check_outline,
        weight=5,
    ),
)
