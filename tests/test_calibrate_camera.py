"""Intrinsics from rendered views of boards, whose camera is known."""

import cv2
import numpy as np
import pytest

from sofjax import viewer
from sofjax.cli import main
from sofjax.io.camera_file import known_mount, read_camera
from sofjax.io.drive import read_drive
from sofjax.io.errors import InputError
from sofjax.vision.boards import Board, Correspondences, find_points, recognise
from sofjax.vision.checkerboard import fit_camera, judge, turning_radius

WIDTH, HEIGHT = 320, 240
K = np.array([[270.0, 0, 161.5], [0, 268.0, 117.5], [0, 0, 1]])
DISTORTION = np.array([-0.14, 0.05, 0.0003, 0.0005, 0.0])
BOARD, SQUARE = Board(9, 6, 0.03), 0.03
FINE = 4  # samples of a pixel, each way
ARGS = ["--board", "9x6", "--square", "0.03"]


@pytest.fixture(scope="module")
def rays():
    """[H, W, FINE², 2] where each sample of each pixel looks, in normalised coordinates."""
    inside = (np.arange(FINE) + 0.5) / FINE - 0.5
    x, y, dx, dy = np.meshgrid(
        np.arange(WIDTH), np.arange(HEIGHT), inside, inside, indexing="ij", sparse=True
    )
    pixels = np.stack(np.broadcast_arrays(x + dx, y + dy), axis=-1).swapaxes(0, 1)
    flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), K, DISTORTION)
    return flat.reshape(HEIGHT, WIDTH, FINE**2, 2)


def render(rays, board, rotation, middle, rng, shades=None):
    """A board on a grey wall, its middle at `middle` metres; `shades` of it are by its squares."""
    R = cv2.Rodrigues(np.asarray(rotation, float))[0]
    centre = board.points.mean(0)
    t = np.asarray(middle) - R @ centre
    to_board = np.linalg.inv(np.stack([R[:, 0], R[:, 1], t], axis=1))
    X, Y, W = np.moveaxis(rays @ to_board[:, :2].T + to_board[:, 2], -1, 0)
    u, v = X / W / board.square, Y / W / board.square
    shade = (shades or chessboard)(board, u, v).mean(-1)
    noisy = cv2.GaussianBlur(shade, (0, 0), 0.5) + rng.normal(0, 1.5, shade.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def chessboard(board, u, v):
    """Squares with a white rim of half a square."""
    columns, rows = board.columns, board.rows
    dark = (np.floor(u) + np.floor(v)) % 2 == 0
    square = (u > -1) & (u < columns) & (v > -1) & (v < rows)
    rim = (u > -1.5) & (u < columns + 0.5) & (v > -1.5) & (v < rows + 0.5)
    return np.where(square & dark, 30.0, np.where(rim, 220.0, 100.0))


def circles(board, u, v):
    """Circles of a quarter of a square's side, or of half of it where rows are set aside."""
    x, y = (board.points[:, :2] / board.square).T
    aside = board.pattern == "acircles"
    i = np.clip(np.rint(v), 0, board.rows - 1)
    step, first = (2, i % 2) if aside else (1, 0)
    j = np.clip(np.rint((u - first) / step), 0, board.columns - 1)
    dark = np.hypot(u - first - step * j, v - i) < (0.5 if aside else 0.3)
    rim = (u > -1) & (u < x.max() + 1) & (v > -1) & (v < y.max() + 1)
    return np.where(rim & dark, 30.0, np.where(rim, 220.0, 100.0))


def charuco(dictionary, legacy):
    """A board as OpenCV draws it, with a white rim of half a square."""

    def shades(board, u, v):
        size = (board.columns, board.rows)
        which = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
        drawn = cv2.aruco.CharucoBoard(size, board.square, board.marker, which)
        drawn.setLegacyPattern(legacy)
        texture = np.float32(drawn.generateImage((60 * size[0], 60 * size[1])))
        j, i = np.floor(60 * u).astype(int), np.floor(60 * v).astype(int)
        inside = (j >= 0) & (j < texture.shape[1]) & (i >= 0) & (i < texture.shape[0])
        rim = (u > -0.5) & (u < size[0] + 0.5) & (v > -0.5) & (v < size[1] + 0.5)
        ink = texture[np.where(inside, i, 0), np.where(inside, j, 0)]
        return np.where(inside, 30 + 190 / 255 * ink, np.where(rim, 220.0, 100.0))

    return shades


def poses(rng, count=14, tilt=0.5, depth=(0.5, 0.75)):
    """Rotations and middles that reach all over the image."""
    spots = [(i % 3 - 1, i // 3 % 3 - 1) for i in range(count)]
    for x, y in spots:
        z = rng.uniform(*depth)
        middle = np.array([x * 0.24 * z + 0.01, y * 0.17 * z, z])
        yield np.append(rng.uniform(-tilt, tilt, 2), rng.uniform(-0.2, 0.2)), middle


def write(folder, images):
    folder.mkdir(exist_ok=True)
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f"{i:02d}.png"), image)
    return folder


@pytest.fixture(scope="module")
def boards(rays, tmp_path_factory):
    """14 views of the board; the last but one is cut off, the last has its rows out of line."""
    rng = np.random.default_rng(5)
    images = [render(rays, BOARD, *pose, rng) for pose in poses(rng)]
    images[12] = render(rays, BOARD, (0.1, 0.2, 0.0), (0.3, 0.0, 0.6), rng)
    bent = images[13].astype(np.float32)
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    bent = cv2.remap(bent, np.float32(x + 2 * np.sin(y / 15)), np.float32(y), cv2.INTER_LINEAR)
    images[13] = bent.astype(np.uint8)
    return write(tmp_path_factory.mktemp("boards") / "views", images)


@pytest.fixture(scope="module")
def done(boards, tmp_path_factory):
    """The command's exit code and output folder, with the mount given."""
    out = tmp_path_factory.mktemp("out") / "camera.yaml"
    args = ["calibrate", "camera", str(boards), *ARGS, "-o", str(out)]
    assert main([*args, "--mount", "height=0.6,pitch=0.26,x=0.05"]) == 0
    return out


def test_the_camera_comes_back(done):
    found = read_camera(done)
    fx, fy = np.diag(np.asarray(found.camera.K))[:2]
    assert fx == pytest.approx(270, rel=0.003) and fy == pytest.approx(268, rel=0.003)
    np.testing.assert_allclose(np.asarray(found.camera.K)[:2, 2], [161.5, 117.5], atol=1)
    assert (found.camera.width, found.camera.height) == (WIDTH, HEIGHT)
    far = np.array([[[310.0, 230.0]]])  # what the lens does near the image's corner
    true = cv2.undistortPoints(far, K, DISTORTION, P=K)
    again = cv2.undistortPoints(far, np.asarray(found.camera.K, float), found.distortion, P=K)
    np.testing.assert_allclose(again, true, atol=1)


def test_the_mount_is_written_and_accepted(done):
    mount = read_camera(done).mount
    assert float(mount.height) == pytest.approx(0.6)
    assert float(mount.pitch) == pytest.approx(0.26)
    assert float(mount.x) == pytest.approx(0.05) and float(mount.y) == 0


def test_it_says_which_views_were_left_out_and_why(boards, tmp_path, capfd):
    assert main(["calibrate", "camera", str(boards), *ARGS, "-o", str(tmp_path / "c.yaml")]) == 0
    out = capfd.readouterr().out
    assert "12 of 14 images of 320x240 used" in out
    lines = {line.split()[0]: line for line in out.splitlines() if ".png" in line}
    assert "left out: no 9x6 corners found" in lines["12.png"]
    assert "times the others' error" in lines["13.png"]
    assert "left out" not in lines["00.png"] and " px " in lines["00.png"]
    assert "verdict   good: the focal length is known to" in out
    assert "fill in the height and the pitch" in out


def test_corners_and_residuals_are_drawn(done):
    image = cv2.imread(str(done.with_suffix(".png")))
    assert min(image.shape[:2]) > 300 and image.std() > 5


def test_without_matplotlib_there_is_no_figure(boards, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(viewer, "available", lambda: False)
    assert main(["calibrate", "camera", str(boards), *ARGS, "-o", str(tmp_path / "c.yaml")]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["c.yaml"]
    assert "sofjax[figures]" in capfd.readouterr().out


def test_a_mount_that_is_not_measured_yet_is_asked_for(boards, tmp_path):
    out = tmp_path / "camera.yaml"
    images = [str(path) for path in sorted(boards.iterdir())[:8]]
    args = ["calibrate", "camera", *images, *ARGS, "-o", str(out)]
    assert main(args) == 0
    with pytest.raises(InputError, match="fill in the metres from the floor to the lens"):
        read_drive(tmp_path)
    assert main([*args, "--mount", "height=0.6,y=-0.02"]) == 0
    with pytest.raises(InputError, match="fill in the radians that the camera looks down"):
        read_camera(out)
    assert known_mount(out) == {"x": 0, "y": -0.02, "height": 0.6, "roll": 0, "yaw": 0}
    text = out.read_text().replace("fill in the radians that the camera looks down", "0.3")
    text = text.replace("sigma: {", "sigma: {height: 0.01, ")
    out.write_text(f"{text}time_offset: -0.11\nodometer: {{left: 0.02}}\n")
    assert main(args) == 0  # what the file has already is kept
    file = read_camera(out)
    mount, fields = file.mount, file.rig_fields
    assert float(mount.pitch) == pytest.approx(0.3) and float(mount.y) == pytest.approx(-0.02)
    assert fields.time_offset == -0.11 and fields.odometer == (0, 0.02, 0, 0)
    assert fields.sigma["height"] == 0.01 and 0 < fields.sigma["focal"] < 0.05


def fitted_views(board, views):
    """The fit to those views that show the board."""
    views = [view for view in views if view is not None]
    assert len(views) >= 9
    return fit_camera(board, WIDTH, HEIGHT, [str(i) for i in range(len(views))], views)


def test_another_board(rays):
    rng = np.random.default_rng(2)
    board = Board(7, 4, 0.05)
    fit = fitted_views(
        board,
        [
            find_points(render(rays, board, *pose, rng), board)
            for pose in poses(rng, depth=(0.6, 0.9))
        ],
    )
    np.testing.assert_allclose(fit.intrinsics[:2], [270, 268], rtol=0.005)
    np.testing.assert_allclose(fit.intrinsics[2:], [161.5, 117.5], atol=1)


OTHER_BOARDS = {
    "circles": (Board(8, 6, 0.03, "circles"), circles, ""),
    "acircles": (Board(4, 11, 0.02, "acircles"), circles, ""),
    "charuco": (Board(7, 5, 0.05, "charuco", 0.037), charuco("4X4_50", False), "4X4_50"),
    "charuco of old": (Board(7, 6, 0.045, "charuco", 0.034), charuco("5X5_1000", True), "5X5_50"),
}


@pytest.mark.parametrize("name", OTHER_BOARDS)
def test_boards_that_are_no_chessboard(rays, name):
    board, shades, dictionary = OTHER_BOARDS[name]
    rng = np.random.default_rng(8)
    images = [
        render(rays, board, *pose, rng, shades) for pose in poses(rng, tilt=0.6, depth=(0.4, 0.6))
    ]
    board = recognise(board, images)
    assert board.dictionary == dictionary and board.legacy == ("old" in name)
    views = [find_points(image, board) for image in images]
    fit = fitted_views(board, views)
    np.testing.assert_allclose(fit.intrinsics[:2], [270, 268], rtol=0.005)
    off = np.abs(fit.intrinsics[2:] - [161.5, 117.5])
    assert (off < np.maximum(1, 2 * fit.intrinsics_sigma[2:])).all()  # OpenCV 4 finds less
    counts = {len(view.points) for view in views if view is not None}
    assert len(counts) > 1 if dictionary else counts == {len(board.points)}  # parts of a ChArUco


def test_the_command_with_a_charuco_board(rays, tmp_path, capfd):
    board, shades, _ = OTHER_BOARDS["charuco"]
    rng = np.random.default_rng(8)
    images = [render(rays, board, *pose, rng, shades) for pose in poses(rng, 9, 0.6, (0.4, 0.6))]
    folder, out = write(tmp_path / "views", images), tmp_path / "camera.yaml"
    args = ["--board", "7x5", "--square", "0.05", "--pattern", "charuco", "--marker", "0.037"]
    args += ["--mount", "height=0.6,pitch=1.5708", "-o", str(out)]
    assert main(["calibrate", "camera", str(folder), *args]) == 0
    assert "board 7x5 of 50 mm, markers of 4X4_50" in capfd.readouterr().out
    np.testing.assert_allclose(np.diag(read_camera(out).camera.K)[:2], [270, 268], rtol=0.01)
    assert out.with_suffix(".png").exists()
    args[1] = "6x4"  # inner corners were counted
    assert main(["calibrate", "camera", str(folder), *args]) == 2
    assert "with --board 7x5 they are found" in capfd.readouterr().err


def test_the_refined_corners_are_those_of_the_board(rays):
    rng = np.random.default_rng(0)
    rotation, middle = np.array([0.3, -0.4, 0.1]), np.array([0.02, 0.01, 0.5])
    t = middle - cv2.Rodrigues(rotation)[0] @ BOARD.points.mean(0)
    true = cv2.projectPoints(BOARD.points, rotation, t, K, DISTORTION)[0].reshape(-1, 2)
    found = find_points(render(rays, BOARD, rotation, middle, rng), BOARD).corners
    away = np.hypot(*(found[:, None] - true).transpose(2, 0, 1)).min(1)
    assert np.sqrt(np.mean(away**2)) < 0.1


def exact(rng, noise, distortion=DISTORTION, **kind):
    """Projected corners with noise, without any image."""
    corners = []
    for rotation, middle in poses(rng, **kind):
        t = middle - cv2.Rodrigues(rotation)[0] @ BOARD.points.mean(0)
        points = cv2.projectPoints(BOARD.points, rotation, t, K, distortion)[0].reshape(-1, 2)
        corners.append(points + rng.normal(0, noise, points.shape))
    return [Correspondences(BOARD.points, found) for found in corners]


def fitted(views):
    return fit_camera(BOARD, WIDTH, HEIGHT, [str(i) for i in range(len(views))], views)


def test_the_standard_deviations_are_those_of_the_errors():
    rng = np.random.default_rng(1)
    fits = [fitted(exact(rng, 0.1)) for _ in range(20)]
    z = [(fit.intrinsics - [270, 268, 161.5, 117.5]) / fit.intrinsics_sigma for fit in fits]
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_a_lens_without_k3_is_given_none():
    fit = fitted(exact(np.random.default_rng(3), 0.05))
    assert fit.distortion[4] == 0 and fit.distortion_sigma[4] == 0
    np.testing.assert_allclose(fit.distortion[0], -0.14, atol=0.02)


def test_where_a_lens_turns_back():
    turning = lambda *terms: turning_radius(K, np.array(terms), WIDTH, HEIGHT)
    assert turning(0, 0, 0, 0, 0) is None and turning(0.3, 0.1, 0, 0, 0) is None
    assert turning(*DISTORTION) is None
    r = 1 / np.sqrt(3 * 0.8)  # the derivative 1 - 3 * 0.8 r² is zero there
    assert turning(-0.8, 0, 0, 0, 0) == pytest.approx(269 * r * (1 - 0.8 * r**2))
    assert turning(0.1, 0, 0, 0, -1.0) is not None
    assert turning(-0.2, 0, 0, 0, 0) is None  # where it turns, 0.86, is beyond the corner, 0.76


def test_a_k3_by_which_the_lens_would_turn_back_is_left_out():
    """Views that keep to the middle of the image may speak for it."""
    lens = np.array([-0.376, 0.9, 0.0, 0.0, -1.86])
    assert turning_radius(K, lens, WIDTH, HEIGHT) == pytest.approx(153, abs=1)
    fit = fitted(exact(np.random.default_rng(3), 0.02, lens, depth=(0.8, 1.0)))
    assert fit.distortion[4] == 0 and fit.turning is None
    np.testing.assert_allclose(fit.intrinsics[:2], [270, 268], rtol=0.01)


def test_a_lens_that_turns_back_without_k3_is_judged():
    lens = np.array([-0.6, 0.0, 0.0, 0.0, 0.0])
    fit = fitted(exact(np.random.default_rng(3), 0.02, lens, depth=(0.8, 1.0)))
    assert fit.turning == pytest.approx(turning_radius(K, lens, WIDTH, HEIGHT), rel=0.05)
    verdict = judge(fit)
    assert verdict.word == "usable"
    assert f"the lens turns back {fit.turning:.0f} px from the centre" in verdict.sentence


def test_views_that_are_all_alike_are_judged():
    rng = np.random.default_rng(4)
    flat = fitted(exact(rng, 0.2, tilt=0.02))
    verdict = judge(flat)
    assert verdict.word != "good" and any("never tilted" in reason for reason in verdict.reasons)
    few = judge(fitted(exact(rng, 0.1, count=6, depth=(0.8, 0.9), tilt=0.3)))
    assert any("6 views are few" in reason for reason in few.reasons)
    assert any("the bottom left, bottom, bottom right" in reason for reason in few.reasons)


def test_what_the_views_do_not_fix_is_not_written(rays, tmp_path, capfd):
    rng = np.random.default_rng(6)
    images = [render(rays, BOARD, (0.0, 0.0, 0.02 * i), (0.0, 0.0, 0.6), rng) for i in range(6)]
    folder, out = write(tmp_path / "views", images), tmp_path / "camera.yaml"
    assert main(["calibrate", "camera", str(folder), *ARGS, "-o", str(out)]) == 3
    said = capfd.readouterr().out
    assert "not usable: " in said and "tilt" in said
    assert f"{out} is not written" in said and not out.exists()
