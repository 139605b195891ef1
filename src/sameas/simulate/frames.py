"""Simulated CCD frames of known stars, with the truth.

Use :func:`frame_of` for stars at known pixels, :func:`frame_of_sky` for a catalogue projected by a WCS (with its SIP
terms, if any) and, optionally, a lens with distortion. The PSF is a :class:`GaussianProfile` or a :class:`Moffat`
profile, averaged over each pixel; photon noise, read-out noise, hot pixels and cosmic rays come from the caller's
Generator.

>>> rng = np.random.default_rng(1)
>>> seen = frame_of(rng, x_px=[20.3, 44.0], y_px=[31.5, 12.2], flux_e=[5e3, 2e4], camera=Camera(shape=(64, 64)))
>>> seen.frame.shape, len(seen.truth)
((64, 64), 2)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.representation import in_short
from sameas.sky.frame.image import Frame
from sameas.sky.frame.keywords import Facts

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.time import Time
    from astropy.wcs import WCS

_FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))
#: A star's light is not drawn where it is below this share of the noise of a pixel (chosen).
_FAINTEST = 0.02


class Profile(Protocol):
    """The profile of a PSF."""

    @property
    def fwhm_px(self) -> float:
        """Full width at half maximum."""

    def density(self, r2_px2: FloatArray) -> FloatArray:
        """Share of the light per px² at a squared distance from the centre."""

    def radius_px(self, share: float) -> float:
        """Distance beyond which the density is below ``share`` per px²."""


@dataclass(frozen=True)
class GaussianProfile:
    """exp(−r²/2σ²) / 2πσ²: the profile of most formulas, and of few real stars."""

    fwhm_px: float = 3.0

    def density(self, r2_px2: FloatArray) -> FloatArray:
        """Share of the light per px² at a squared distance from the centre."""
        variance = (self.fwhm_px / _FWHM_PER_SIGMA) ** 2
        return np.exp(-0.5 * r2_px2 / variance) / (2 * math.pi * variance)

    def radius_px(self, share: float) -> float:
        """Distance beyond which the density is below ``share`` per px²."""
        variance = (self.fwhm_px / _FWHM_PER_SIGMA) ** 2
        return math.sqrt(2 * variance * max(-math.log(min(share * 2 * math.pi * variance, 1.0)), 1.0))


@dataclass(frozen=True)
class Moffat:
    """(β−1)/πα² · (1 + r²/α²)^−β: the wings of stars seen through air (β about 3; Moffat 1969, A&A 3, 455)."""

    fwhm_px: float = 3.0
    beta: float = 3.0

    def __post_init__(self) -> None:
        if not self.beta > 1:
            raise InputError(f"Moffat: beta is {self.beta}; above 1 the light is finite")

    def density(self, r2_px2: FloatArray) -> FloatArray:
        """Share of the light per px² at a squared distance from the centre."""
        alpha2 = self._alpha2()
        return (self.beta - 1) / (math.pi * alpha2) * (1 + r2_px2 / alpha2) ** -self.beta

    def radius_px(self, share: float) -> float:
        """Distance beyond which the density is below ``share`` per px²."""
        alpha2 = self._alpha2()
        ratio = (self.beta - 1) / (math.pi * alpha2) / share
        return math.sqrt(alpha2 * max(ratio ** (1 / self.beta) - 1, 1.0))

    def _alpha2(self) -> float:
        return self.fwhm_px**2 / 4 / (2 ** (1 / self.beta) - 1)


@dataclass(frozen=True)
class Trail:
    """Motion of the frame relative to the stars during the exposure; the angle is measured from +x to +y."""

    length_px: float = 0.0
    angle_deg: float = 0.0

    def steps(self, finest_px: float) -> FloatArray:
        """(k, 2) positions along the trail, centred on (0, 0), at most ``finest_px`` apart."""
        count = 1 + 2 * math.ceil(self.length_px / finest_px / 2)
        along = ((np.arange(count) + 0.5) / count - 0.5) * self.length_px
        angle = math.radians(self.angle_deg)
        return np.outer(along, [math.cos(angle), math.sin(angle)])


@dataclass(frozen=True)
class Lens:
    """Radial distortion: a point at the corner is displaced outwards by ``corner_px``, others in proportion to r³."""

    corner_px: float = 0.0

    def __call__(self, xy_px: FloatArray, shape: tuple[int, int]) -> FloatArray:
        """(n, 2) the displaced points."""
        centre = (np.array(shape[::-1]) - 1) / 2
        offset = xy_px - centre
        corner = float(np.hypot(*centre))
        r2 = (offset**2).sum(axis=1, keepdims=True) / corner**2
        return np.asarray(xy_px + offset / corner * r2 * self.corner_px, np.float64)


@dataclass(frozen=True)
class Camera:
    """The detector and the sky background.

    shape : (rows, columns). gain_e_per_adu, read_noise_e, sky_e : electrons per ADU, of the read-out noise (1σ), of the
    sky per pixel. bias_adu : level without light. saturation_e : full well of a pixel, at which its ADU saturate.
    hot_pixels : number of pixels with a dark current, of ``hot_e`` electrons on average. cosmics : number of cosmic
    rays, each with about ``cosmic_e`` electrons per pixel along a short straight track.
    """

    shape: tuple[int, int] = (512, 512)
    gain_e_per_adu: float = 1.5
    read_noise_e: float = 6.0
    sky_e: float = 100.0
    bias_adu: float = 1000.0
    saturation_e: float = 90_000.0
    hot_pixels: int = 0
    hot_e: float = 3000.0
    cosmics: int = 0
    cosmic_e: float = 1500.0

    def __post_init__(self) -> None:
        if min(self.shape) < 8:
            raise InputError(f"Camera: shape is {self.shape}; give 8 pixels or more")
        for name in ("gain_e_per_adu", "saturation_e"):
            if not getattr(self, name) > 0:
                raise InputError(f"Camera: {name} is {getattr(self, name)}; give a number above zero")
        if min(self.read_noise_e, self.sky_e, self.hot_pixels, self.cosmics) < 0:
            raise InputError("Camera: read noise, sky, hot pixels and cosmics are zero or more")

    def saturation_adu(self) -> float:
        """Value of a full pixel."""
        return math.floor(min(self.bias_adu + self.saturation_e / self.gain_e_per_adu, 65535.0))


@dataclass(frozen=True)
class Truth:
    """The stars within the frame. x_px, y_px : (n,) true centres, 0-based. flux_e : (n,) electrons.

    star : (n,) their rows in the input. hot, struck : (rows, columns) masks of hot pixels and of cosmic rays.
    """

    x_px: FloatArray
    y_px: FloatArray
    flux_e: FloatArray
    star: IntArray
    hot: BoolArray
    struck: BoolArray

    def __len__(self) -> int:
        return len(self.x_px)


@in_short
@dataclass(frozen=True)
class SimulatedFrame:
    """A frame and its truth."""

    frame: Frame
    truth: Truth


def frame_of(
    rng: np.random.Generator,
    *,
    x_px: ArrayLike,
    y_px: ArrayLike,
    flux_e: ArrayLike,
    camera: Camera | None = None,
    psf: Profile | None = None,
    trail: Trail | None = None,
    exposure_s: float = 60.0,
    mid_time: Time | None = None,
    header: Header | None = None,
    name: str = "simulated",
) -> SimulatedFrame:
    """A frame of stars at known pixels (0-based) with known fluxes in electrons; the truth has only those inside."""
    camera, trail = camera or Camera(), trail or Trail()
    xy = np.column_stack([np.asarray(x_px, float), np.asarray(y_px, float)])
    flux = np.broadcast_to(np.asarray(flux_e, float), len(xy))
    if not (np.isfinite(xy).all() and (flux >= 0).all()):
        raise InputError(f"{name}: stars have positions and fluxes that are finite, fluxes zero or more")
    rows, columns = camera.shape
    inside = np.flatnonzero((np.abs(xy - [(columns - 1) / 2, (rows - 1) / 2]) < [columns / 2, rows / 2]).all(axis=1))
    light = _light(camera, GaussianProfile() if psf is None else psf, trail, xy, flux)
    hot = _scattered(rng, camera.shape, camera.hot_pixels)
    light[hot] += rng.exponential(camera.hot_e, int(hot.sum()))
    struck_e = _tracks(rng, camera)
    adu = _read_out(rng, camera, light, struck_e)
    facts = Facts(
        gain_e_per_adu=camera.gain_e_per_adu,
        read_noise_e=camera.read_noise_e,
        saturation_adu=camera.saturation_adu(),
        exposure_s=exposure_s,
        mid_time=mid_time,
        lines=("simulated",),
        name=name,
    )
    truth = Truth(xy[inside, 0], xy[inside, 1], flux[inside], inside.astype(np.int64), hot, struck_e > 0)
    return SimulatedFrame(Frame.of(adu, facts=facts, header=header, name=name), truth)


def frame_of_sky(
    rng: np.random.Generator,
    *,
    ra_deg: ArrayLike,
    dec_deg: ArrayLike,
    magnitude: ArrayLike,
    wcs: WCS,
    zero_point: float = 20.0,
    lens: Lens | None = None,
    camera: Camera | None = None,
    psf: Profile | None = None,
    trail: Trail | None = None,
    exposure_s: float = 60.0,
    mid_time: Time | None = None,
    name: str = "simulated",
) -> SimulatedFrame:
    """A frame of catalogue stars, at their directions at the time of the exposure.

    ra_deg, dec_deg, magnitude : (n,) at that time: propagate them with ``sameas.sky.motion``. wcs : from sky to pixels,
    including distortions. zero_point : magnitude of one electron per second. The truth's ``star`` is the row in these
    columns. Stars behind the tangent plane are ignored. The frame's header has no WCS, like that of a raw frame; add
    ``wcs.to_header()`` if needed.
    """
    camera = camera or Camera()
    ra, dec, mag = (np.asarray(values, float) for values in (ra_deg, dec_deg, magnitude))
    ahead = np.flatnonzero(_distance_deg(ra, dec, wcs) < _reach_deg(wcs, camera.shape))
    xy = np.column_stack(wcs.all_world2pix(ra[ahead], dec[ahead], 0)) if len(ahead) else np.empty((0, 2))
    xy = (lens or Lens())(xy, camera.shape)
    finite = np.isfinite(xy).all(axis=1) & np.isfinite(mag[ahead])
    simulated = frame_of(
        rng,
        x_px=xy[finite, 0],
        y_px=xy[finite, 1],
        flux_e=exposure_s * 10 ** (-0.4 * (mag[ahead[finite]] - zero_point)),
        camera=camera,
        psf=psf,
        trail=trail,
        exposure_s=exposure_s,
        mid_time=mid_time,
        name=name,
    )
    truth = simulated.truth
    stars = ahead[finite][truth.star]
    return SimulatedFrame(simulated.frame, Truth(truth.x_px, truth.y_px, truth.flux_e, stars, truth.hot, truth.struck))


# ---- light ----


def _light(camera: Camera, psf: Profile, trail: Trail, xy: FloatArray, flux: FloatArray) -> FloatArray:
    """(rows, columns) mean number of electrons of sky and stars."""
    light = np.full(camera.shape, camera.sky_e, float)
    noise = math.sqrt(camera.sky_e + camera.read_noise_e**2 + 1)
    steps = trail.steps(psf.fwhm_px / 4)
    for centre, electrons in zip(xy, flux, strict=True):
        reach = psf.radius_px(_FAINTEST * noise / max(electrons, 1e-9)) + 1
        low = np.maximum(np.ceil(centre - reach - np.abs(steps[0])), 0).astype(int)
        high = np.minimum(np.floor(centre + reach + np.abs(steps[0])) + 1, camera.shape[::-1]).astype(int)
        if (low < high).all():
            box = slice(low[1], high[1]), slice(low[0], high[0])
            light[box] += electrons * _spread(psf, centre, steps, low, high)
    return light


def _spread(psf: Profile, centre: FloatArray, steps: FloatArray, low: IntArray, high: IntArray) -> FloatArray:
    """Share of a star's light in every pixel of a box, averaged over each pixel (Gauss-Legendre) and over the trail."""
    nodes, weights = np.polynomial.legendre.leggauss(4 if psf.fwhm_px < 3 else 3)
    share = np.zeros((high[1] - low[1], high[0] - low[0]))
    for step in steps:
        x = np.add.outer(np.arange(low[0], high[0]) - centre[0] - step[0], nodes / 2)
        y = np.add.outer(np.arange(low[1], high[1]) - centre[1] - step[1], nodes / 2)
        r2 = (y**2)[:, :, None, None] + (x**2)[None, None]
        share += np.einsum("yaxb,a,b->yx", psf.density(r2), weights / 2, weights / 2)
    return share / len(steps)


def _scattered(rng: np.random.Generator, shape: tuple[int, int], count: int) -> BoolArray:
    where = np.zeros(shape, bool)
    where.ravel()[rng.choice(where.size, min(count, where.size), replace=False)] = True
    return where


def _tracks(rng: np.random.Generator, camera: Camera) -> FloatArray:
    """(rows, columns) electrons of cosmic rays: straight tracks of one to about ten pixels."""
    struck = np.zeros(camera.shape)
    for _ in range(camera.cosmics):
        start = rng.uniform(size=2) * camera.shape
        angle, length = rng.uniform(0, 2 * math.pi), rng.exponential(4.0)
        along = np.arange(0, length + 1, 0.5)[:, None] * [math.sin(angle), math.cos(angle)]
        pixels = np.unique(np.floor(start + along).astype(int), axis=0)
        pixels = pixels[((pixels >= 0) & (pixels < camera.shape)).all(axis=1)]
        struck[tuple(pixels.T)] += camera.cosmic_e * rng.uniform(0.5, 1.5, len(pixels))
    return struck


def _read_out(rng: np.random.Generator, camera: Camera, light: FloatArray, struck_e: FloatArray) -> NDArray[np.uint16]:
    electrons = np.minimum(rng.poisson(light) + struck_e, camera.saturation_e)
    electrons = electrons + rng.normal(0.0, camera.read_noise_e, camera.shape)
    adu = np.rint(camera.bias_adu + electrons / camera.gain_e_per_adu)
    return np.clip(adu, 0, camera.saturation_adu()).astype(np.uint16)


# ---- sky ----


def _distance_deg(ra_deg: FloatArray, dec_deg: FloatArray, wcs: WCS) -> FloatArray:
    ra_0, dec_0 = np.radians(wcs.wcs.crval)
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    cosine = np.sin(dec) * math.sin(dec_0) + np.cos(dec) * math.cos(dec_0) * np.cos(ra - ra_0)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.float64)


def _reach_deg(wcs: WCS, shape: tuple[int, int]) -> float:
    """1.1 times the distance from the tangent point to the farthest corner of the frame, at most 80°."""
    rows, columns = shape
    corners = wcs.wcs_pix2world([[0, 0], [columns, 0], [0, rows], [columns, rows]], 0)
    return min(1.1 * float(_distance_deg(corners[:, 0], corners[:, 1], wcs).max()), 80.0)
