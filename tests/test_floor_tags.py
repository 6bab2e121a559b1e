"""Floor tags in the plant: printed the right way round, where the drawing and the faults say."""

import mujoco
import numpy as np
import pytest
from floor_bench import FloorBench

from twin.geometry import between2, compose2, inverse, pose2_to_transform
from twin.layout import LayoutError, Tolerances, load_layout
from twin.plant.as_built import AsBuilt
from twin.plant.factory import build
from twin.plant.floor_tags import QUIET, SIDE, TEXELS, plate_side, printed_code, true_pose
from twin.stack.config import nominal_config
from twin.stack.detection.qr import TagReader
from twin.tag_text import TagText, format_tag

FAULTS = (
    'world.faults.tags=[{tag = "M1", kind = "damaged"}, {tag = "Q1", kind = "foreign"},'
    ' {tag = "R7", kind = "misplaced", shift = [0.03, -0.02, 0.2]}]'
)


@pytest.fixture(scope="module")
def bench():
    bench = FloorBench(FAULTS, noise=0.0)
    yield bench
    bench.close()


def read(bench, name, offset=(0.0, 0.0, 0.0)):
    reader = TagReader(bench.config.tag_camera)
    return reader.read(bench.shoot(compose2(bench.tags[name], offset))), reader


def test_plate_has_the_drawn_code():
    texture = printed_code(format_tag(TagText("G7", (1.0, 2.0, 0.0), ("N4",))))
    modules = texture.shape[0] / TEXELS - 2 * QUIET
    assert modules == 25 and texture.min() < 50 and texture.max() > 200
    assert (texture[: QUIET * TEXELS] == texture.max()).all()
    assert plate_side(texture) * modules / (modules + 2 * QUIET) == pytest.approx(SIDE)
    layout = load_layout()
    assert nominal_config(layout.site, layout.options).tag_side == SIDE


def test_print_is_not_mirrored(bench):
    """Expected: the picture shows the texture itself where the camera's drawing puts it.

    The reader alone would not tell: its decoder also reads codes in a mirror.
    """
    tag, offset = bench.tags["P1"], np.array([0.01, -0.015, 0.4])
    image = bench.shoot(compose2(tag, offset)).image.astype(float)
    drawn = next(t for t in bench.layout.site.tags if t.name == "P1")
    texture = printed_code(format_tag(TagText(drawn.name, drawn.pose, drawn.next)))
    modules = texture.shape[0] // TEXELS - 2 * QUIET
    dark = texture[TEXELS // 2 :: TEXELS, TEXELS // 2 :: TEXELS] < 128
    dark = dark[QUIET:-QUIET, QUIET:-QUIET]
    row, column = np.mgrid[0:modules, 0:modules]
    x, y = ((column + 0.5) / modules - 0.5) * SIDE, (0.5 - (row + 0.5) / modules) * SIDE
    p_tag = np.stack([x.ravel(), y.ravel(), 0 * x.ravel(), np.ones(x.size)])
    camera = bench.config.tag_camera
    T_base_tag = inverse(pose2_to_transform(compose2(tag, offset))) @ pose2_to_transform(tag)
    p_camera = (inverse(camera.T_base_camera) @ T_base_tag @ p_tag)[:3]
    u, v, w = camera.matrix @ p_camera
    seen = image[np.rint(v / w).astype(int), np.rint(u / w).astype(int)].reshape(modules, modules)
    assert np.mean((seen < 120) == dark) > 0.98


def test_tags_can_be_read_where_they_are_drawn(bench):
    for name in ("W0", "C0", "G0", "R1"):
        (fix,), _ = read(bench, name, (0.02, -0.03, 1.0))
        drawn = next(t for t in bench.layout.site.tags if t.name == name)
        assert (fix.text.tag_id, fix.text.next_nodes) == (name, drawn.next)
        np.testing.assert_allclose(fix.text.pose, drawn.pose, atol=1e-3)
        found = compose2(compose2(bench.tags[name], (0.02, -0.03, 1.0)), fix.pose_base_tag)
        np.testing.assert_allclose(found, bench.tags[name], atol=1e-3)


def test_a_damaged_tag_cannot_be_read(bench):
    for offset in ((0, 0, 0), (0.02, 0.02, 0.5), (-0.03, 0, 2.0)):
        fixes, _ = read(bench, "M1", offset)
        assert fixes == ()


def test_a_foreign_tag_names_another_place(bench):
    (fix,), _ = read(bench, "Q1")
    assert fix.text.tag_id == "Q2"  # the next of the drawing


def test_a_misplaced_tag_lies_elsewhere_and_says_nothing_of_it(bench):
    (fix,), _ = read(bench, "R7")
    assert fix.text.tag_id == "R7"
    np.testing.assert_allclose(fix.pose_base_tag, (0.03, -0.02, 0.2), atol=1e-3)


def test_placement_error_has_its_tolerance():
    tolerances, tag = Tolerances(), load_layout().site.tags[0]
    off = np.array(
        [
            between2(tag.pose, true_pose(tag, None, tolerances, np.random.default_rng((s, 0))))
            for s in range(400)
        ]
    )
    np.testing.assert_allclose(off.std(axis=0), (0.002, 0.002, np.radians(0.3)), rtol=0.12)
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=8e-4)


def plates(*overrides, seed=3):
    layout = load_layout(overrides=overrides)
    as_built = AsBuilt.draw(np.random.default_rng(seed), layout.world.tolerances)
    spec = build(layout, as_built, pool=1)
    return {g.name: (*g.pos, *g.quat) for g in spec.geoms if g.name.startswith("tag_")}


def test_a_tag_keeps_its_place_whatever_befalls_others():
    plain, faulty, other = plates(), plates(FAULTS), plates(seed=4)
    assert len(plain) == len(load_layout().site.tags)
    moved = {name for name in plain if plain[name] != faulty[name]}
    assert moved == {"tag_R7"}
    assert all(plain[name] != other[name] for name in plain)


def test_nothing_feels_a_tag(bench):
    model = bench.world.model
    ids = [g for g in range(model.ngeom) if model.geom(g).name.startswith("tag_")]
    assert ids and not model.geom_contype[ids].any() and not model.geom_conaffinity[ids].any()
    assert not model.geom_group[ids].any()  # of the floor camera's only group
    assert model.geom_type[ids[0]] == mujoco.mjtGeom.mjGEOM_BOX


def test_a_fault_of_an_unknown_tag_is_refused():
    with pytest.raises(LayoutError, match="no tag 'Z9'"):
        load_layout(overrides=('world.faults.tags=[{tag = "Z9", kind = "damaged"}]',))
