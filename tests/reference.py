"""The rules again, in plain numpy: one pair at a time, slow, and easy to check by eye.

Nothing here calls the library; its objects (`Camera`, `Mount`, ...) are read for their numbers.
A pose is (x, y, yaw), a line in polar form (rho, theta), a segment its two end points.
"""

import numpy as np

# Frames, eqs. (1) and (2)


def rotation(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    if axis == "x":
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    if axis == "y":
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def pose_matrix(pose):
    x, y, yaw = np.asarray(pose, float)
    return np.array([[np.cos(yaw), -np.sin(yaw), x], [np.sin(yaw), np.cos(yaw), y], [0, 0, 1]])


def pose_of(matrix):
    return np.array([matrix[0, 2], matrix[1, 2], np.arctan2(matrix[1, 0], matrix[0, 0])])


def camera_axes_and_centre(mount, pose):
    """R_world_camera and C."""
    optical = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # right, down, forward in robot axes
    R_robot_camera = (
        rotation("z", float(mount.yaw))
        @ rotation("y", float(mount.pitch))
        @ rotation("x", float(mount.roll))
        @ optical
    )
    centre = pose_matrix(pose) @ [float(mount.x), float(mount.y), 1]
    return rotation("z", pose[2]) @ R_robot_camera, np.array([*centre[:2], float(mount.height)])


def in_camera(mount, pose, points_world):
    """World points in camera axes: right, down, depth."""
    R, C = camera_axes_and_centre(mount, pose)
    return (np.asarray(points_world, float) - C) @ R


def project(K, mount, pose, points_world):
    """Pixels of world points, and their depths."""
    q = in_camera(mount, pose, points_world)
    return (q @ np.asarray(K, float).T)[..., :2] / q[..., 2:], q[..., 2]


def projection_matrix(K, mount, pose):
    R, C = camera_axes_and_centre(mount, pose)
    return np.asarray(K, float) @ R.T @ np.column_stack([np.eye(3), -C])


# The floor, eqs. (3) and (10) to (13)


def floor_homography(K, mount, pose):
    return projection_matrix(K, mount, pose)[:, [0, 1, 3]]


def back_project(K, mount, pose, pixel):
    """Where the ray of a pixel meets Z = 0, and whether it does so before the camera."""
    R, C = camera_axes_and_centre(mount, pose)
    ray = R @ np.linalg.solve(np.asarray(K, float), [*pixel, 1])
    if ray[2] >= 0:
        return np.zeros(2), False
    return (C - C[2] / ray[2] * ray)[:2], True


def plane_pair(P, line, P2, line2):
    """L as the two planes that views of it span, [lᵀP; l'ᵀP']; eq. (3)."""
    return np.stack([line @ P, line2 @ P2])


def trace_on_floor(planes):
    """The point in which the line of eq. (3) meets the floor Z = 0."""
    x = np.cross(planes[0, [0, 1, 3]], planes[1, [0, 1, 3]])
    return x[:2] / x[2]


# Lines


def homogeneous(point):
    return np.append(np.asarray(point, float), 1)


def line_through(x1, x2):
    return np.cross(homogeneous(x1), homogeneous(x2))


def polar_through(x1, x2):
    theta = np.arctan2(x2[1] - x1[1], x2[0] - x1[0])
    return float(np.dot([-np.sin(theta), np.cos(theta)], x1)), float(theta)


def polar_difference(a, b):
    """The smallest of the differences that the many names of one line allow."""
    names = [((-1) ** (k % 2) * b[0], b[1] + k * np.pi) for k in range(-4, 5)]
    return min(((a[0] - rho, a[1] - theta) for rho, theta in names), key=lambda d: abs(d[1]))


def overlap(first, second):
    first, second = np.asarray(first), np.asarray(second)
    length = np.linalg.norm(second[1] - second[0])
    if length == 0:
        return 0.0
    unit = (second[1] - second[0]) / length
    a, b = sorted(point @ unit for point in first), sorted(point @ unit for point in second)
    return min(a[1], b[1]) - max(a[0], b[0])


# Association, eq. (9)


def transfer_segment(H, segment, min_ratio=0.05):
    """Both ends by x' ~ H x; the part whose depth ratio is less than `min_ratio` cut off."""
    a, b = (np.asarray(H, float) @ homogeneous(x) for x in segment)
    if a[2] <= min_ratio and b[2] <= min_ratio:
        return None
    whole = (a, b)
    if a[2] < min_ratio:
        a = a + (min_ratio - a[2]) / (whole[1][2] - a[2]) * (whole[1] - a)
    if b[2] < min_ratio:
        b = b + (min_ratio - b[2]) / (whole[0][2] - b[2]) * (whole[0] - b)
    return np.array([a[:2] / a[2], b[:2] / b[2]])


def association_error(config, K, H, first, second):
    centre = np.asarray(K, float)[:2, 2]
    moved = transfer_segment(H, first)
    if moved is None or overlap(moved, second) <= 0:
        return np.inf
    d_rho, d_theta = polar_difference(
        polar_through(*(np.asarray(second, float) - centre)), polar_through(*(moved - centre))
    )
    return config.alpha * abs(d_rho) + config.beta * abs(d_theta)


def associate(config, K, H, first, first_valid, second, second_valid):
    """For each segment of the second image: the smallest error, and whose."""
    errors, partners = [], []
    for j in range(len(second)):
        best, partner = np.inf, 0
        for i in range(len(first)):
            if first_valid[i] and second_valid[j]:
                error = association_error(config, K, H, first[i], second[j])
                if error < best:
                    best, partner = error, i
        errors.append(best)
        partners.append(partner)
    return np.array(errors), np.array(partners)


# Sensor model


def log_likelihood(lines, counted, candidates, e_max, pose):
    """-1/2 sum_m min(min_k e[m,k], e_max).

    `candidates[m]` are (rho, theta, the apparent scale, W) as they should appear from the origin.
    """
    total = 0.0
    for line, counts, own in zip(lines, counted, candidates, strict=True):
        if not counts:
            continue
        best = e_max
        for rho, theta, apparent_scale, W in own:
            n = np.array([-np.sin(theta), np.cos(theta)])
            seen = (rho - apparent_scale * n @ pose[:2], theta - pose[2])
            d = np.array(polar_difference(line, seen))
            best = min(best, d @ W @ d)
        total += best
    return -total / 2


def best_jitter(cost, sigma):
    """The (pitch, roll) that costs least, by search on finer and finer grids about the best."""
    centre, width = np.zeros(2), 6 * sigma
    for _ in range(40):
        steps = np.linspace(-width, width, 7)
        grid = centre + np.array([[a, b] for a in steps for b in steps])
        centre = min(grid, key=cost)
        width *= 0.6
    return centre


# A drive: what a camera sees of segments on the floor


def look(camera, mount, pose, segments_world, near=0.05):
    """Segments in the image of a camera, cut at its borders; no noise, no occlusion."""
    seen = []
    borders = [([1, 0], 0), ([-1, 0], camera.width - 1), ([0, 1], 0), ([0, -1], camera.height - 1)]
    for ends in np.asarray(segments_world, float):
        if ends.shape[-1] == 2:
            ends = np.column_stack([ends, np.zeros(2)])
        ends = cut(ends, in_camera(mount, pose, ends)[:, 2] - near)
        if ends is None:
            continue
        segment, _ = project(camera.K, mount, pose, ends)
        for normal, offset in borders:
            segment = None if segment is None else cut(segment, segment @ normal + offset)
        if segment is not None and np.linalg.norm(segment[1] - segment[0]) > 8:
            seen.append(segment)
    return np.array(seen).reshape(-1, 2, 2)


def cut(ends, above):
    """The part of a segment on which an affine function of these end values is positive."""
    if (above <= 0).all():
        return None
    if (above > 0).all():
        return ends
    crossing = ends[0] + above[0] / (above[0] - above[1]) * (ends[1] - ends[0])
    return np.array([crossing, ends[1]]) if above[0] <= 0 else np.array([ends[0], crossing])
