"""Measure how OpenCV's tag detector errs on a landing pad, at six settings: writes tags.csv.

    python notebooks/data/tags.py             # all views, minutes; needs the extra `data`
    python notebooks/data/tags.py --views 20  # the first ones only, to compare

A pad of 1.4 m with AprilTag 36h11 number 7 (Olson 2011) is seen from above, from 5 to 100 ft, by a
camera of 640 x 480 pixels and a focal length of 500: with up to 8 degrees of tilt, any heading, off
centre by up to a tenth of the altitude, blurred, in more or less light, with noise.  Each view has
a random stream of its own.  Each setting, a scale of the picture and a refinement of corners, sees
the same view; the altitude follows from the four corners.  A row says what it erred by, in feet,
and how long it took; it is empty where no tag was found.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np

FOOT, PAD = 0.3048, 1.4  # m
LOWEST, HIGHEST = 5.0, 100.0  # ft
WIDTH, HEIGHT, FOCAL = 640, 480, 500.0  # pixels
VIEWS, TAG, MARGIN, SIDE = 1600, 7, 50, 400
CAMERA = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
CORNERS = PAD / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
REFINEMENTS = {
    "none": cv2.aruco.CORNER_REFINE_NONE,
    "subpixel": cv2.aruco.CORNER_REFINE_SUBPIX,
    "apriltag": cv2.aruco.CORNER_REFINE_APRILTAG,
}
#: Scale of the picture, refinement of corners.
SETTINGS = [(0.25, "none"), (0.5, "subpixel"), (0.5, "apriltag")]
SETTINGS += [(1.0, "none"), (1.0, "subpixel"), (1.0, "apriltag")]


def rotation(axis: int, angle: float) -> np.ndarray:
    return cv2.Rodrigues(angle * np.eye(3)[axis])[0]


def view(number: int) -> tuple[float, np.ndarray]:
    """Return the altitude of a view in feet, and its picture."""
    rng = np.random.default_rng([36, number])
    altitude = float(np.exp(rng.uniform(np.log(LOWEST), np.log(HIGHEST))))
    tilt, heading = np.radians(rng.uniform(-8, 8, 2)), rng.uniform(0, 2 * np.pi)
    down = np.diag([1.0, -1, -1])
    R = rotation(0, tilt[0]) @ rotation(1, tilt[1]) @ down @ rotation(2, heading)
    place = altitude * FOOT * np.array([*rng.uniform(-0.1, 0.1, 2), 1])
    marker = cv2.aruco.generateImageMarker(DICTIONARY, TAG, SIDE, borderBits=1)
    marker = np.pad(marker, MARGIN, constant_values=255)
    pixel, n = PAD / SIDE, len(marker)
    ground = np.array([[pixel, 0, -pixel * n / 2], [0, -pixel, pixel * n / 2], [0, 0, 1]])
    seen = CAMERA @ np.column_stack([R[:, :2], -R @ place]) @ ground
    fine = np.diag([2.0, 2, 1]) @ seen  # twice the pixels, then averaged
    size = (2 * WIDTH, 2 * HEIGHT)
    picture = cv2.warpPerspective(marker, fine, size, flags=cv2.INTER_AREA, borderValue=140)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.6 * rng.uniform(0.7, 1.6))
    picture = cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(float)
    picture = picture * rng.uniform(0.5, 1) + rng.normal(0, 6, picture.shape)
    return altitude, np.clip(picture, 0, 255).astype(np.uint8)


def detectors() -> list[cv2.aruco.ArucoDetector]:
    """Return a detector for each setting."""
    found = []
    for _, refinement in SETTINGS:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = REFINEMENTS[refinement]
        found.append(cv2.aruco.ArucoDetector(DICTIONARY, parameters))
    return found


def altitude_of(picture: np.ndarray, scale: float, detector: cv2.aruco.ArucoDetector) -> float:
    """Return the altitude in feet by the corners of the tag; NaN if it is not found."""
    if scale < 1:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    corners, numbers, _ = detector.detectMarkers(picture)
    if numbers is None or TAG not in numbers:
        return np.nan
    corner = corners[numbers.ravel().tolist().index(TAG)].reshape(4, 2).astype(float)
    corner = (corner + 0.5) / scale - 0.5
    method = cv2.SOLVEPNP_IPPE_SQUARE
    _, turn, shift = cv2.solvePnP(CORNERS, corner, CAMERA, None, flags=method)
    return float((-cv2.Rodrigues(turn)[0].T @ shift)[2, 0]) / FOOT


def rows(numbers: range) -> list[tuple[str, int, float, float, float]]:
    """Return model, view, milliseconds, altitude and residual of every setting on every view."""
    cv2.setNumThreads(1)
    found, able = [], detectors()
    for number in numbers:
        altitude, picture = view(number)
        for (scale, refinement), detector in zip(SETTINGS, able, strict=True):
            started = perf_counter()
            residual = altitude_of(picture, scale, detector) - altitude
            milliseconds = 1e3 * (perf_counter() - started)
            found.append((f"{scale:g} {refinement}", number, milliseconds, altitude, residual))
    return found


def text(found: list[tuple[str, int, float, float, float]]) -> str:
    """Return the rows as a file that `perception.read_residuals` takes."""
    lines = ["model,view,milliseconds,altitude,residual"]
    for model, number, milliseconds, altitude, residual in sorted(found, key=lambda row: row[1]):
        error = "" if np.isnan(residual) else f"{residual:.4f}"
        lines.append(f"{model},{number},{milliseconds:.2f},{altitude:.4f},{error}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure a tag detector on rendered views.")
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".csv"))
    options = parser.parse_args()
    options.output.write_text(text(rows(range(options.views))))
