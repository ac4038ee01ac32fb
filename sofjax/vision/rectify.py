"""The floor seen from above, from one image."""

import cv2
import jax.numpy as jnp
import numpy as np

from sofjax.geometry import SE2, Camera, Mount, floor_homography


def rectify(
    image: np.ndarray,
    camera: Camera,
    mount: Mount,
    T_floor_robot: np.ndarray,
    extent: tuple[float, float, float, float],
    pixels: int = 480,
) -> np.ndarray:
    """The floor as it would look from above; eq. (11).

    **Arguments:**
    - `image`: grey, undistorted.
    - `T_floor_robot`: [3] pose (x, y, yaw) of the robot in the frame of `extent`.
    - `extent`: x from, x to, y from, y to in metres: up and left in the result.

    **Returns:** grey, `pixels` high; zero outside of the image.
    """
    x0, x1, y0, y1 = extent
    width = round(pixels * (y1 - y0) / (x1 - x0))
    T = SE2(jnp.asarray(T_floor_robot[:2], float), jnp.asarray(T_floor_robot[2], float))
    H_F = np.asarray(floor_homography(camera, mount, T), float)
    i, j = np.mgrid[:pixels, :width]
    x, y = x1 - (i + 0.5) / pixels * (x1 - x0), y1 - (j + 0.5) / width * (y1 - y0)
    u, v, depth = np.moveaxis(np.stack([x, y, np.ones_like(x)], axis=-1) @ H_F.T, -1, 0)
    ahead = depth > 1e-6
    u, v = (np.where(ahead, c / np.where(ahead, depth, 1), -1e4).astype(np.float32) for c in (u, v))
    return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
