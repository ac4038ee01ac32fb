"""Eqs. (8) and (9) for many motions at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_batch import image_problem, make_camera

from sofjax.extraction import association_scores, homographies, transferred_lines
from sofjax.extraction.association import Association, association_error
from sofjax.geometry import SE2, Mount, Segments, floor_homography, two_view_homography
from sofjax.geometry.two_view import transfer_segment


def motions(N):
    r = np.random.default_rng(8)
    xy, yaw = r.normal(0, 0.2, (N, 2)), r.normal(0, 0.2, N)
    return SE2(jnp.asarray(xy, float), jnp.asarray(yaw, float))


@pytest.mark.usefixtures("x64")
def test_homographies_are_those_of_each_motion_and_of_poses():
    camera, mount = make_camera(), Mount.create(0.5, 0.4, x=0.1)
    T = motions(5)
    H = homographies(camera, mount, T)
    floor = floor_homography(camera, mount, SE2.identity())
    for n in range(5):
        one = SE2(T.xy[n], T.yaw[n])
        np.testing.assert_allclose(H[n], two_view_homography(camera, mount, one), rtol=1e-9)
        other = floor_homography(camera, mount, one) @ jnp.linalg.inv(floor)
        same = H[n] / jnp.linalg.norm(H[n]) - other / jnp.linalg.norm(other)
        np.testing.assert_allclose(same, 0, atol=1e-12)  # H = H_F(T') H_F(T)^-1 up to scale
    at = SE2(jnp.array([3.0, -2.0]), jnp.array(1.0))
    np.testing.assert_allclose(homographies(camera, mount, at.between(at @ T)), H, rtol=1e-7)


@pytest.mark.usefixtures("x64")
def test_transferred_lines_pass_through_transferred_points():
    mount, _, image, _ = image_problem(1)
    H = homographies(make_camera(), mount, motions(4))
    lines = transferred_lines(H, image)
    assert lines.shape == (4, 8, 3)
    points = jnp.concatenate([image.endpoints, jnp.ones((8, 2, 1))], axis=-1)
    moved = jnp.einsum("nij,mej->nmei", H, points)
    product = jnp.einsum("nmi,nmei->nme", lines, moved)
    size = jnp.linalg.norm(lines, axis=-1)[..., None] * jnp.linalg.norm(moved, axis=-1)
    assert float(jnp.abs(product / size).max()) < 1e-12
    none = transferred_lines(H, Segments(image.endpoints, jnp.zeros(8, bool)))
    assert not none.any()


def test_association_scores_are_eq_9_of_every_pair():
    config, mount = Association(), Mount.create(0.5, 0.4)
    _, _, first, _ = image_problem(1)
    T = motions(2)
    H = homographies(make_camera(), mount, T)
    moved, _ = jax.vmap(transfer_segment, in_axes=(None, 0))(H[0], first.endpoints[:6])
    second = Segments(moved + 1.0, jnp.array([True] * 5 + [False]))
    scores = association_scores(config, make_camera(), H, first, second)
    assert scores.shape == (2, 8, 6)
    assert jnp.isinf(scores[:, :, 5]).all() and jnp.isfinite(scores).any()
    one = jax.jit(association_error)
    for n, i, j in np.ndindex(2, 8, 5):
        want = one(config, make_camera(), H[n], first.endpoints[i], second.endpoints[j])
        np.testing.assert_allclose(scores[n, i, j], want, rtol=1e-3, atol=1e-2)
