"""Which segments of two images show the same line on the floor; eq. (9)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from conftest import as_float32, jit_quickly

from sofjax.extraction.association import Association, associate, association_error
from sofjax.geometry import SE2, Mount, Segments, two_view_homography

pytestmark = pytest.mark.usefixtures("x64")

match, one_error = jit_quickly(associate), jit_quickly(association_error)
CENTRE = np.array([159.5, 119.5])


def ahead(distance):
    return SE2(jnp.array([distance, 0.0], float), jnp.array(0.0, float))


def segments(*ends):
    ends = jnp.array(ends, float).reshape(-1, 2, 2)
    return Segments(ends, jnp.ones(len(ends), bool))


def error_of(camera, first, second, H=None, **settings):
    first, second = (jnp.asarray(np.asarray(s, float) + CENTRE) for s in (first, second))
    H = jnp.eye(3) if H is None else H
    return float(one_error(Association(**settings), camera, H, first, second))


def test_an_error_worked_by_hand(camera):
    # 3 px lower and turned by 0.01 rad about the centre's column: 1 * 3 + 60 * 0.01
    across = [[-50, 40], [50, 40]]
    turned = [[-50, 43 - 50 * np.tan(0.01)], [50, 43 + 50 * np.tan(0.01)]]
    d_rho = 43 * np.cos(0.01) - 40
    assert error_of(camera, across, turned) == pytest.approx(d_rho + 0.6, abs=1e-9)
    assert error_of(camera, across, turned, alpha=2.0, beta=10.0) == pytest.approx(
        2 * d_rho + 0.1, abs=1e-9
    )


def test_the_two_errors_cannot_cancel(camera):
    """As the signed ones of eq. (9) could: here rho' < rho'' and theta' > theta''."""
    across = [[-50, 40], [50, 40]]
    turned = [[-50, 37 - 50 * np.tan(0.05)], [50, 37 + 50 * np.tan(0.05)]]
    assert error_of(camera, across, turned) == pytest.approx(
        40 - 37 * np.cos(0.05) + 60 * 0.05, abs=1e-9
    )


def test_the_direction_of_a_segment_does_not_matter(camera):
    first, second = [[-50, 0.1], [50, -0.2]], [[-40, -0.3], [60, 0.2]]  # near rho = 0
    errors = [error_of(camera, a, b) for a in (first, first[::-1]) for b in (second, second[::-1])]
    np.testing.assert_allclose(errors, errors[0], atol=1e-9)
    assert errors[0] < 1


def test_the_error_is_taken_about_the_principal_point(camera):
    """About the corner of the image the same turn would count as 160 px of rho."""
    up = [[0, -50], [0, 50]]
    turned = [[-50 * np.sin(0.1), -50 * np.cos(0.1)], [50 * np.sin(0.1), 50 * np.cos(0.1)]]
    assert error_of(camera, up, turned) == pytest.approx(6.0, abs=1e-9)


def test_segments_of_one_line_that_do_not_overlap_are_not_associated(camera):
    assert error_of(camera, [[-50, 40], [-10, 40]], [[-5, 40], [50, 40]]) == np.inf
    assert error_of(camera, [[-50, 40], [-10, 40]], [[-10, 40], [50, 40]]) == np.inf  # touching
    assert error_of(camera, [[-50, 40], [-10, 40]], [[-11, 40], [50, 40]]) == 0


def test_what_the_robot_drove_past_is_associated_with_nothing(camera):
    H = two_view_homography(camera, Mount.create(height=1.0), ahead(3.0))
    two_metres_ahead = [[-50, 135], [50, 135]]
    assert error_of(camera, two_metres_ahead, two_metres_ahead, H) == np.inf


@pytest.mark.parametrize(("z", "driven"), [(0.0, 0.5), (0.1, 0.05), (0.1, 0.5), (-0.3, 0.5)])
def test_the_error_of_a_line_across_the_way_is_its_parallax(camera, z, driven):
    """A line at height z seems to be at range r h / (h - z), and to come nearer by too little."""
    h, r, f = 0.6, 2.0, 270.0
    rows = [f * (h - z) / (r - moved) for moved in (0, driven)]
    predicted = f * h / (r * h / (h - z) - driven)  # the row if it lay on the floor
    H = two_view_homography(camera, Mount.create(height=h), ahead(driven))
    first, second = ([[-50, row], [50, row]] for row in rows)
    assert error_of(camera, first, second, H) == pytest.approx(abs(rows[1] - predicted), abs=1e-9)


def scene(camera, mount, z, driven):
    """A tiled floor's lines, or the same lines at a height, seen before and after a motion."""
    lines = [[[x, -0.6], [x, 0.6]] for x in (1.4, 1.9, 2.5)] + [
        [[1.2, y], [3, y]] for y in (-0.7, 0.3, 0.9)
    ]
    ends = np.concatenate([lines, np.full((6, 2, 1), z)], axis=2)
    first = reference.look(camera, mount, (0, 0, 0), ends)
    second = reference.look(camera, mount, (driven, 0, 0), ends)
    assert len(first) == len(second) == 6
    return segments(*first), segments(*second)


def test_floor_lines_are_associated_one_to_one(camera, mount):
    for driven in (0.05, 0.3, 0.5):
        H = two_view_homography(camera, mount, ahead(driven))
        matches = match(Association(gate=1.0), camera, H, *scene(camera, mount, 0.0, driven))
        assert matches.matched.all()
        np.testing.assert_array_equal(matches.partner, np.arange(6))
        np.testing.assert_allclose(matches.error, 0, atol=1e-6)


def test_lines_over_the_floor_are_told_from_it_by_a_long_baseline_only(camera, mount):
    """5 cm apart, two images cannot tell the top of a baseboard from the floor."""
    told = []
    for driven in (0.05, 0.5):
        H = two_view_homography(camera, mount, ahead(driven))
        first, second = scene(camera, mount, 0.1, driven)
        own = [
            one_error(Association(), camera, H, *pair)
            for pair in zip(first.endpoints, second.endpoints, strict=True)
        ]
        told.append(np.array(own) > 2.0)
    assert not told[0].any()
    assert told[1][:3].all()  # lines across the way: range moves them


def test_nothing_is_associated_beyond_the_gate(camera):
    first, second = segments([[100, 200], [200, 200]]), segments([[100, 203], [200, 203]])
    for gate, expected in ((3.0 - 1e-6, False), (3.0 + 1e-6, True)):
        matches = match(Association(gate=gate), camera, jnp.eye(3), first, second)
        assert bool(matches.matched[0]) == expected
        assert matches.error[0] == pytest.approx(3)


def test_the_most_similar_partner_is_chosen(camera):
    first = segments(*([[100, row], [200, row]] for row in (194, 199, 202, 206)))
    second = segments([[100, 200], [200, 200]], [[100, 205], [200, 205]])
    matches = match(Association(), camera, jnp.eye(3), first, second)
    np.testing.assert_array_equal(matches.partner, [1, 3])
    np.testing.assert_allclose(matches.error, [1, 1])


@pytest.mark.parametrize("padded", ["first", "second"])
def test_padding_is_never_associated(camera, padded):
    both = {name: segments([[100, 200], [200, 200]]) for name in ("first", "second")}
    both[padded] = Segments(both[padded].endpoints, jnp.array([False]))
    matches = match(Association(), camera, jnp.eye(3), both["first"], both["second"])
    assert not matches.matched[0]
    assert matches.error[0] == jnp.inf


def test_an_image_without_segments_has_no_matches(camera):
    nothing = Segments(jnp.zeros((3, 2, 2)), jnp.zeros(3, bool))
    matches = match(Association(), camera, jnp.eye(3), nothing, nothing)
    assert not matches.matched.any()


def test_all_pairs_at_once_are_the_loop_over_pairs(camera, mounts, rng):
    some = 0
    for mount in mounts:
        T = SE2(jnp.asarray(rng.normal(size=2) * 0.1), jnp.asarray(rng.normal() * 0.1))
        H = two_view_homography(camera, mount, T)
        ends = rng.uniform([0, 0], [320, 240], size=(2, 9, 2, 2))
        moved = np.concatenate([ends[0], np.ones((9, 2, 1))], axis=2) @ np.asarray(H).T
        moved = moved[..., :2] / moved[..., 2:]
        ends[1, 3:] = (moved + rng.normal(size=(9, 2, 2)))[3:]  # true partners among strangers
        valid = rng.random((2, 9)) < 0.8
        config = Association(gate=8.0)
        first, second = (
            Segments(jnp.asarray(e), jnp.asarray(v)) for e, v in zip(ends, valid, strict=True)
        )
        matches = match(config, camera, H, first, second)
        errors, partners = reference.associate(
            config, camera.K, H, ends[0], valid[0], ends[1], valid[1]
        )
        np.testing.assert_allclose(matches.error, errors, rtol=1e-6, atol=1e-6)
        found = np.isfinite(errors)
        np.testing.assert_array_equal(matches.partner[found], partners[found])
        np.testing.assert_array_equal(matches.matched, errors < config.gate)
        some += (errors < config.gate).sum()
    assert some > 10


def test_float32_gives_the_error_to_a_tenth_of_a_pixel(camera, mount, rng):
    H = two_view_homography(camera, mount, ahead(0.4))
    first, second = scene(camera, mount, 0.05, 0.4)
    exact = match(Association(), camera, H, first, second)
    with jax.enable_x64(False):
        found = match(Association(), *as_float32((camera, H, first, second)))
    np.testing.assert_allclose(found.error, exact.error, atol=0.1)
