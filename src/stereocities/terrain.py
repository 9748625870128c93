"""Terrain and water of a city."""

from __future__ import annotations

import math

import numpy as np

from .cities import CitySpec

TERRAIN_STEP_M = 10.0
TEXTURE_SIZE = 1024
FINE_STEP_M = 0.25
BROAD_STEP_M = 2.0


def spectral_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    step: float,
    band: tuple[float, float],
    slope: float,
) -> np.ndarray:
    """Periodic Gaussian noise [ny, nx] of unit spread.

    Wavelengths within ``band`` (m); amplitude falls as frequency to the power ``-slope``.
    """
    fy = np.fft.fftfreq(shape[0], step)[:, None]
    fx = np.fft.rfftfreq(shape[1], step)[None, :]
    f = np.hypot(fx, fy)
    with np.errstate(divide="ignore"):
        amplitude = np.where((f >= 1 / band[1]) & (f <= 1 / band[0]), f**-slope, 0.0)
    amplitude[0, 0] = 0
    phase = np.exp(2j * np.pi * rng.random(amplitude.shape))
    noise = np.fft.irfft2(amplitude * phase * rng.normal(1, 0.3, amplitude.shape), s=shape)
    return noise / max(noise.std(), 1e-12)


def make_terrain(
    city: CitySpec, rng: np.random.Generator, box: tuple[float, float, float, float]
) -> tuple[np.ndarray, float]:
    """Spline coefficients [ny, nx] of the terrain, and the water's level (−1e9: none)."""
    c = city.character
    nx = int((box[2] - box[0]) / TERRAIN_STEP_M) + 6
    ny = int((box[3] - box[1]) / TERRAIN_STEP_M) + 6
    size = 2 ** math.ceil(math.log2(max(nx, ny, 2.2 * c.wavelength_m / TERRAIN_STEP_M)))
    shape = (size, size)
    hills = spectral_noise(
        rng, shape, TERRAIN_STEP_M, (c.wavelength_m / 3.5, c.wavelength_m * 1.3), 3.0
    )
    rough = spectral_noise(rng, shape, TERRAIN_STEP_M, (120, 500), 2.2)
    micro = spectral_noise(rng, shape, TERRAIN_STEP_M, (40, 90), 1.0)
    hills, rough, micro = (a[:ny, :nx] for a in (hills, rough, micro))
    x = box[0] + TERRAIN_STEP_M * np.arange(nx)
    y = box[1] + TERRAIN_STEP_M * np.arange(ny)
    floor = np.quantile(hills, c.valley)
    rise = hills - floor
    rise = (rise + np.sqrt(rise**2 + 0.05)) / 2  # a plain that bends smoothly into hills
    z = rise * (1 + 0.07 * rough)
    z -= z.min()
    z *= c.relief_m / max(z.max(), 1e-9)
    for _ in range(8):  # relief gives way to the steepest slope allowed
        gy, gx = np.gradient(z, TERRAIN_STEP_M)
        steepest = math.degrees(math.atan(np.hypot(gx, gy).max()))
        if steepest <= c.max_slope_deg:
            break
        # soften where it is too steep rather than lower everything
        k = 2 if steepest < c.max_slope_deg * 1.3 else 4
        for _ in range(k):
            p = np.pad(z, 1, mode="edge")
            blurred = (p[:-2, 1:-1] + p[2:, 1:-1] + p[1:-1, :-2] + p[1:-1, 2:] + 4 * z) / 8
            steep = np.clip(np.hypot(gx, gy) / math.tan(math.radians(c.max_slope_deg)) - 0.7, 0, 1)
            z = z + np.minimum(1, 3 * steep) * (blurred - z)
    gy, gx = np.gradient(z, TERRAIN_STEP_M)
    z *= min(1.0, math.tan(math.radians(48)) / max(np.hypot(gx, gy).max(), 1e-9))
    z += 4 + 0.12 * micro
    water = -1e9
    if c.river_m:
        # a winding river: the ground falls to below the water along it
        water = 2.2
        phase = rng.uniform(0, 2 * np.pi, 2)
        angle = rng.uniform(0.15, 0.9)
        xx, yy = np.meshgrid(x, y)
        middle = np.mean([s.centre_m for s in city.scenes], axis=0)
        p = (xx - middle[0]) * math.cos(angle) + (yy - middle[1]) * math.sin(angle)
        q = (yy - middle[1]) * math.cos(angle) - (xx - middle[0]) * math.sin(angle)
        if c.relief_m > 150:  # follow the valley: the river lies where the hills are lowest
            weights = np.exp(-((z - z.min()) / 20))
            slope, level = np.polyfit(p.ravel(), q.ravel(), 1, w=weights.ravel())
            q = q - (slope * p + level)
        else:
            q = q - rng.uniform(-0.22, 0.22) * (box[3] - box[1])
        q = q - 110 * np.sin(p / 420 + phase[0]) - 40 * np.sin(p / 170 + phase[1])
        bank = 0.5 * c.river_m + 6 * rough
        depth = np.clip((bank - np.abs(q)) / 14, -1.5, 1)  # banks of about 20 degrees
        if c.relief_m > 150:  # slopes of 27 degrees at most from the river up
            cap = 5.0 + 0.5 * np.maximum(np.abs(q) - 0.6 * c.river_m, 0)
            z = -3.0 * np.logaddexp(-z / 3.0, -cap / 3.0)
        valley = 0.0 if c.relief_m > 150 else np.exp(-((np.abs(q) / (c.river_m * 2.5)) ** 2))
        z = z * (1 - valley) + np.minimum(z, 5.0 + 0.02 * z) * valley
        z = np.where(depth > -1.5, np.minimum(z, 2.2 - 4.0 * depth), z)
    if c.lakes:
        water = max(water, 2.2)
        dips = spectral_noise(rng, shape, TERRAIN_STEP_M, (250, 900), 1.5)[:ny, :nx]
        low = np.clip((dips - 1.75) / 0.25, 0, 1) * np.clip((14 - z) / 6, 0, 1)
        z = z * (1 - low) + (2.2 - c.lakes) * low
    if not c.river_m and not c.lakes:
        water = -1e9
    return z, water
