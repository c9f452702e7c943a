"""Measure how stereo matchers err on a motorcycle, seven of them: writes stereo.csv.

    python notebooks/data/stereo.py              # some seconds; needs the extra `data`
    python notebooks/data/stereo.py --patches 40 # the first ones only, to compare

The pair of pictures and its true disparity are those of Middlebury's "Motorcycle" (Scharstein et
al. 2014) as scikit-image ships them.  OpenCV's block matching (BM) and semi-global matching (SGBM,
Hirschmueller 2008; HH: all directions) run on the pictures at three scales.  A view is a patch of
20 x 20 pixels whose true depth is known for half of its pixels or more, and varies by less than a
tenth; what a matcher says of it is the median depth of its pixels, or nothing where it has fewer
than half of them.  A row has the view, the milliseconds of a whole picture, the true depth and the
residual in metres, which is empty where the matcher said nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
from skimage.data import stereo_motorcycle

FOCAL, BASELINE, OFFSET = (
    994.978,
    0.193001,
    31.086,
)  # pixels, m, pixels (scikit-image's documentation)
SIDE, RANGE = 20, 80  # pixels: of a patch, of disparity
SCALES = (0.25, 0.5, 1.0)
REPEATS = 5  # the median of which is the time


def depth(disparity: np.ndarray) -> np.ndarray:
    """Return depth in m; NaN where there is no disparity."""
    known = np.isfinite(disparity) & (disparity > 0)
    return np.where(known, FOCAL * BASELINE / (np.where(known, disparity, 1) + OFFSET), np.nan)


def matchers() -> Iterator[tuple[str, float, Callable[[], cv2.StereoMatcher]]]:
    """Return name, scale and maker of every matcher."""
    for scale in SCALES:
        span = 16 * int(np.ceil(RANGE * scale / 16))
        block = 15 if scale == 1 else 9
        yield f"BM {scale:g}", scale, lambda n=span, b=block: cv2.StereoBM_create(n, b)
        modes = {"SGBM": cv2.STEREO_SGBM_MODE_SGBM_3WAY}
        if scale == 1:
            modes["SGBM-HH"] = cv2.STEREO_SGBM_MODE_HH
        for name, mode in modes.items():
            smooth = {"P1": 8 * 25, "P2": 32 * 25, "uniquenessRatio": 5}
            speckles = {"speckleWindowSize": 50, "speckleRange": 2}
            options = {"numDisparities": span, "blockSize": 5, "mode": mode} | smooth | speckles
            yield f"{name} {scale:g}", scale, lambda o=options: cv2.StereoSGBM_create(**o)


def run(left: np.ndarray, right: np.ndarray, scale: float, make: Callable) -> tuple:
    """Return depth (rows, columns) of one matcher, and its milliseconds."""
    sizes = {"fx": scale, "fy": scale, "interpolation": cv2.INTER_AREA}
    small = [cv2.resize(picture, None, **sizes) for picture in (left, right)]
    matcher, taken = make(), []
    for _ in range(REPEATS + 1):  # the first warms up
        started = perf_counter()
        found = matcher.compute(*small)
        taken.append(1e3 * (perf_counter() - started))
    disparity = found.astype(float) / 16  # in sixteenths of a pixel
    full = cv2.resize(disparity, left.shape[::-1], interpolation=cv2.INTER_NEAREST) / scale
    return depth(full), float(np.median(taken[1:]))


def median(patch: np.ndarray) -> float:
    """Return the median of a patch; NaN where fewer than half of its pixels are known."""
    return float(np.nanmedian(patch)) if np.isfinite(patch).mean() >= 0.5 else np.nan


def rows(count: int | None = None) -> list[tuple[str, int, float, float, float]]:
    """Return model, view, milliseconds, true depth and residual of every matcher on every patch."""
    cv2.setNumThreads(1)
    left, right, disparity = stereo_motorcycle()
    truth = depth(disparity)
    left, right = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (left, right))
    corners = np.ndindex(truth.shape[0] // SIDE, truth.shape[1] // SIDE)
    patches = [np.s_[r * SIDE : (r + 1) * SIDE, c * SIDE : (c + 1) * SIDE] for r, c in corners]
    even = [np.isfinite(truth[p]).mean() >= 0.5 and np.nanstd(truth[p]) < 0.1 * np.nanmedian(truth[p])
            for p in patches]  # fmt: skip
    kept = [patch for patch, good in zip(patches, even, strict=True) if good][:count]
    found = []
    for name, scale, make in matchers():
        estimate, milliseconds = run(left, right, scale, make)
        for view, patch in enumerate(kept):
            z = median(truth[patch])
            found.append((name, view, milliseconds, z, median(estimate[patch]) - z))
    return sorted(found, key=lambda row: row[1])


def text(found: list[tuple[str, int, float, float, float]]) -> str:
    """Return the rows as a file that `perception.read_residuals` takes."""
    lines = ["model,view,milliseconds,distance,residual"]
    for model, view, milliseconds, z, residual in found:
        error = "" if np.isnan(residual) else f"{residual:.4f}"
        lines.append(f"{model},{view},{milliseconds:.2f},{z:.4f},{error}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure stereo matchers on a motorcycle.")
    parser.add_argument("--patches", type=int)
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".csv"))
    options = parser.parse_args()
    options.output.write_text(text(rows(options.patches)), encoding="utf-8")
