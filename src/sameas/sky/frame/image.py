"""Images: a frame from a FITS file with its facts and pixel flags, and its calibration.

:func:`read` accepts plain and compressed FITS files (``.gz``, tile-compressed ``.fz``) and photographs, several
extensions, integers (scaled and unsigned) and floats, three planes of colours (their mean), error and data-quality
planes, and a user's mask.
``frame.facts`` has a line for every assumption.

Bias, dark and flat are applied, and bad pixels of darks and flats are flagged:

    light = (raw − bias − (dark − bias) t/t_dark) / flat,   raw − dark without a bias,

each a median of several frames, robust against cosmic rays.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, robust_scale
from sameas.bounds import checked_fits
from sameas.errors import InputError, first_line, optional, reading
from sameas.representation import in_short
from sameas.sky.frame.keywords import Facts, Given
from sameas.sky.frame.measurements import PIXEL_FLAGS, Flag

if TYPE_CHECKING:
    from astropy.io.fits import HDUList, Header


Image = NDArray[np.float32]
PixelFlags = NDArray[np.uint16]

_QUALITY = ("DQ", "MASK", "BPM", "FLAGS", "QUALITY")
_ERROR = ("ERR", "ERROR", "SIGMA", "UNCERT", "RMS")
_VARIANCE = ("VAR", "VARIANCE")
#: Planes of an image in colours.
_COLOURS = 3
#: Flags of the bits in masks of the Rubin pipelines, by their keywords; other bits mark detections.
_PLANES = {"MP_BAD": Flag.MASKED, "MP_NO_DATA": Flag.MASKED, "MP_SAT": Flag.SATURATED, "MP_CR": Flag.COSMIC}
#: Suffixes of photographs.
PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
#: Tags of EXIF, and of its folder of the exposure.
_EXIF, _TAKEN, _ZONE, _SECONDS = 0x8769, 0x9003, 0x9011, 0x829A


@in_short
@dataclass(frozen=True)
class Frame:
    """One image and the facts of its exposure.

    Attributes
    ----------
    image : (rows, columns) pixel values in ADU, or the unit of BUNIT; ``image[y, x]``. Pixels without a number are 0.
    flags : (rows, columns) bits of :class:`Flag`: saturated, hot, cosmic, masked.
    facts : gain, noise, exposure, time, station and aim, and every assumption.
    header : of the image, completed with cards of the primary header.
    name : of the file, used in messages.
    sigma : (rows, columns) standard deviation of each pixel, or None without such a plane.
    """

    image: Image
    flags: PixelFlags
    facts: Facts
    header: Header | None = None
    name: str = "frame"
    sigma: Image | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = self.image.shape
        return rows, columns

    @property
    def masked(self) -> BoolArray:
        """(rows, columns) mask of the unusable pixels."""
        return np.asarray((self.flags & Flag.MASKED) != 0)

    def marked(self, where: BoolArray, flag: Flag) -> Frame:
        """The frame with ``flag`` set on the pixels of a mask."""
        return replace(self, flags=self.flags | np.where(where, flag, 0).astype(np.uint16))

    @classmethod
    def of(
        cls,
        image: Any,
        *,
        facts: Facts | None = None,
        mask: Any = None,
        flags: PixelFlags | None = None,
        sigma: Any = None,
        header: Header | None = None,
        name: str = "frame",
    ) -> Frame:
        """A frame from arrays, checked.

        image : (rows, columns). Pixels that are not finite are masked. mask : (rows, columns), true or non-zero for
        unusable pixels. flags : (rows, columns) bits of :class:`Flag`. sigma : standard deviation of each pixel.

        Raises
        ------
        InputError : not two-dimensional, no usable pixel, planes of another shape, all pixels equal.
        """
        values = np.asarray(image)
        if values.ndim > 2 and values.size == np.prod(values.shape[-2:]):
            values = values.reshape(values.shape[-2:])
        if values.ndim != 2 or min(values.shape, default=0) < 8:
            raise InputError(
                f"{name}: the image has shape {values.shape}; give one of two dimensions (or three planes of colours "
                "in a file), 8 pixels or more"
            )
        pixel_flags = np.zeros(values.shape, np.uint16) if flags is None else flags & np.uint16(PIXEL_FLAGS)
        if mask is not None:
            pixel_flags = pixel_flags | _masked(mask, values.shape, name)
        finite = np.isfinite(values)
        if not finite.any():
            raise InputError(f"{name}: no pixel is a finite number; the frame is empty, calibrate or copy it again")
        pixel_flags = pixel_flags | np.where(finite, 0, Flag.MASKED).astype(np.uint16)
        usable = (pixel_flags & Flag.MASKED) == 0
        if not usable.any():
            raise InputError(f"{name}: every pixel is masked; check the mask or the data-quality plane")
        facts = Facts() if facts is None else facts
        facts = facts.with_saturation(values[usable], np.asarray(image).dtype)
        pixel_flags |= np.where(usable & (values >= facts.saturation_adu), Flag.SATURATED, 0).astype(np.uint16)
        _refuse_flat(values[usable], facts, name)
        sigma = None if sigma is None else _plane(sigma, values.shape, name, "sigma")
        pixels = np.where(usable, values, 0).astype(np.float32)
        return cls(pixels, pixel_flags, facts, header, name, sigma)


def read(
    path: str | Path, *, hdu: int | str | None = None, mask: str | Path | None = None, given: Given | None = None
) -> Frame:
    """One image of a FITS file, or a photograph.

    path : FITS, plain, ``.gz`` or tile-compressed ``.fz``; JPEG, PNG or TIFF.
    hdu : number or EXTNAME of the image; by default the first extension named SCI, else the first image.
    mask : a second FITS file, non-zero for unusable pixels.
    given : facts that replace those of the header.

    Raises InputError: no such file, not FITS, truncated, no image, no such extension, only NaN, all saturated.
    """
    path = Path(path)
    name = path.name
    planes, header, notes = _load(path, hdu)
    with reading(name, "its header cannot be read"):
        facts = Facts.of(header, given or Given(), name=name, notes=notes)
    bad = None if mask is None else _load(Path(mask), None)[0]["image"]
    image, flags = unwrapped(planes["image"]), planes["quality"]
    if image is not planes["image"]:
        facts = replace(facts, lines=(*facts.lines, "doubt: numbers below zero were unsigned ones, stored as signed"))
    if image.ndim == 3 and len(image) == _COLOURS:
        image, flags, facts = _without_colours(image, flags, facts, given or Given())
    return Frame.of(image, facts=facts, mask=bad, flags=flags, sigma=planes["sigma"], header=header, name=name)


def _without_colours(
    planes: NDArray[Any], flags: PixelFlags | None, facts: Facts, given: Given
) -> tuple[NDArray[Any], PixelFlags, Facts]:
    """The mean of three planes of colours, its flags and facts; a pixel is saturated if it is in any plane."""
    flags = np.zeros(planes.shape[1:], np.uint16) if flags is None else flags
    for plane in planes:
        level = facts.with_saturation(plane[np.isfinite(plane)], planes.dtype).saturation_adu
        flags = flags | np.where(plane >= level, Flag.SATURATED, 0).astype(np.uint16)
    lines = (*facts.lines, "image: the mean of three planes of colours")
    if math.isfinite(facts.gain_e_per_adu) and given.gain_e_per_adu is None:
        # Planes of a colour matrix share pixels, so that the noise of their mean does not follow from the gain.
        facts = replace(facts, gain_e_per_adu=math.nan)
        lines += ("assumed: the gain is that of one plane; gain not known, the noise is taken from the image",)
    return planes.mean(axis=0, dtype=np.float64), flags, replace(facts, lines=lines)


def photograph(path: Path) -> tuple[NDArray[Any], Header, tuple[str, ...]]:
    """The pixels of a photograph, in one plane or three, the facts of its EXIF as a header, and notes.

    The first row is the lowest, as in FITS, so that the sky is not mirrored.

    Raises InputError: not an image, damaged, or of a kind that Pillow does not read.
    """
    from astropy.io.fits import Header

    with optional("photographs need Pillow", "plots"):
        from PIL import Image
    try:
        with Image.open(path) as picture:
            plain = picture if picture.mode in ("L", "RGB", "I;16", "I", "F") else picture.convert("RGB")
            pixels = np.asarray(plain)[::-1]
            exif = dict(picture.getexif().get_ifd(_EXIF))
    except Exception as error:  # Pillow raises many types of errors on damaged files
        raise InputError(f"{path.name}: the photograph cannot be read ({first_line(error)}); convert it") from error
    header, notes = Header(), ["a photograph: rows are counted from the lowest, as in FITS"]
    if _SECONDS in exif:
        header["EXPTIME"] = float(exif[_SECONDS])
    if _TAKEN in exif:
        date, _, time = str(exif[_TAKEN]).partition(" ")
        header["DATE-OBS"] = f"{date.replace(':', '-')}T{time}"
        notes.append(f"doubt: the time is that of the camera{_zone(exif)}, taken for UTC")
    return (pixels if pixels.ndim == 2 else np.moveaxis(pixels, -1, 0)), header, tuple(notes)


def _zone(exif: dict[int, Any]) -> str:
    return f", whose clock is {exif[_ZONE]} of UTC" if _ZONE in exif else ""


def unwrapped(image: NDArray[Any]) -> NDArray[Any]:
    """The image, unsigned where it was stored as signed: else neighbours jump from one end of the range to the other.

    >>> unwrapped(np.array([[32766, 32767, -32768, -32767]], np.int16)).tolist()
    [[32766, 32767, 32768, 32769]]
    """
    kind = image.dtype
    if kind.kind != "i" or kind.itemsize != 2 or not (image < 0).any():
        return image
    unsigned = image.astype(np.int32) & 0xFFFF
    jumps = [
        int((np.abs(np.diff(values, axis=-1)) > np.iinfo(np.int16).max).sum())
        for values in (image.astype(np.int32), unsigned)
    ]
    return unsigned.astype(np.uint16) if jumps[0] > jumps[1] else image


def _load(path: Path, hdu: int | str | None) -> tuple[dict[str, Any], Header, tuple[str, ...]]:
    """The image with its planes, its header, and notes on the choice of the extension."""
    from astropy.utils.exceptions import AstropyWarning

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix.lower() in PHOTOGRAPHS:
        pixels, facts, lines = photograph(path)
        return {"image": pixels, "quality": None, "sigma": None}, facts, lines
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyWarning)
            # Otherwise astropy only warns, and fails later or returns zeros.
            warnings.filterwarnings("error", message="File may have been truncated")
            with _opened(path) as hdus:
                chosen, notes = _chosen(hdus, hdu, path)
                image = hdus[chosen].data
                planes = {"image": image, **_companions(hdus, chosen, image.shape[-2:])}
                header = hdus[chosen].header.copy(strip=False)
                if chosen:
                    _inherit(header, hdus[0].header)
    except (InputError, MemoryError, ImportError):
        raise
    except Warning as warning:
        raise InputError(f"{path.name}: the file is cut short ({warning}); copy it again") from warning
    except Exception as error:  # astropy raises many types of errors on damaged files
        raise InputError(
            f"{path.name}: the file cannot be read as FITS ({first_line(error)}); copy it again or convert it"
        ) from error
    return planes, header, notes


def _inherit(header: Header, primary: Header) -> None:
    """Adds the keywords of the primary header that the extension's does not have."""
    for card in primary.cards:
        if card.keyword and card.keyword not in header and card.keyword not in ("COMMENT", "HISTORY"):
            header.append(card, end=True)


#: astropy's decoders in C. On damaged data that of HCOMPRESS writes out of bounds, and those of PLIO and Rice read out
#: of bounds (found by fuzzing astropy 7.2 and 8.0).
_RICE = ("RICE_1", "RICE_ONE")
_DECODED_IN_C = ("HCOMPRESS_1", "PLIO_1", *_RICE)
#: Settings with which the decoder of Rice reads at most a block beyond the data, and the size of a tile in bytes up to
#: which this stays in memory of the process.
_RICE_BLOCKS, _RICE_PIXEL_BYTES, _RICE_TILE_BYTES = (16, 32), (1, 2, 4), 1 << 16
#: Timeout of the decoder, seconds: an image takes one or two, damaged memory can make it hang.
_DECODED_S = 120
_DECODE = """
import sys, warnings
from astropy.io import fits
warnings.simplefilter("ignore")
with fits.open(sys.argv[1], memmap=False, disable_image_compression=True) as tables:
    # The decoder of PLIO believes the length in a list, and may return pixels from beyond the tile.
    lists = [each.data["COMPRESSED_DATA"] for each in tables if each.header.get("ZCMPTYPE") == "PLIO_1"]
    for words in (words for tiles in lists for words in tiles):
        begin, short, low, high = (int(word) for word in words[1:5]) if len(words) > 4 else (0, 0, 0, 0)
        length = short if short > 0 else (high << 15) + low
        if begin < 0 or length > len(words):
            raise ValueError(f"a list of {length} words in a tile of {len(words)}")
with fits.open(sys.argv[1], memmap=False) as hdus:
    plain = [fits.PrimaryHDU(hdus[0].data, hdus[0].header)]
    for each in hdus[1:]:
        plain.append(fits.ImageHDU(each.data, each.header) if each.is_image else each)
    fits.HDUList(plain).writeto(sys.argv[2], output_verify="silentfix+ignore")
"""


@contextmanager
def _opened(path: Path) -> Iterator[HDUList]:
    """The extensions of a FITS file. Where a damaged image could end the process, another process decodes it."""
    from astropy.io import fits

    checked = checked_fits(path)
    with checked.open("rb") if isinstance(checked, Path) else checked as file, fits.open(file, memmap=False) as hdus:
        in_c = any(getattr(each, "compression_type", None) in _DECODED_IN_C for each in hdus)
        if not (in_c and _can_crash(file)):
            yield hdus
            return
    with tempfile.TemporaryDirectory(prefix="sameas-") as folder:
        decoded = Path(folder) / "decoded.fits"
        command = [sys.executable, "-c", _DECODE, str(path.absolute()), str(decoded)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_DECODED_S)
        except subprocess.TimeoutExpired:
            raise InputError(
                f"{path.name}: its compressed image could not be decoded in {_DECODED_S} s; copy it again"
            ) from None
        if done.returncode:
            words = done.stderr.strip().splitlines()[-1:] or ["no words"]
            raise InputError(f"{path.name}: its compressed image is damaged ({words[0]}); copy it again")
        with fits.open(decoded, memmap=False) as hdus:
            yield hdus


def _can_crash(file: Any) -> bool:
    """Whether the decoder of any compressed image could end the process if the image is damaged."""
    from astropy.io import fits

    file.seek(0)
    tables = fits.open(file, memmap=False, disable_image_compression=True)
    try:
        return any(decoder_can_crash(each.header) for each in tables)
    finally:
        tables.close(closed=False)


def decoder_can_crash(header: Header) -> bool:
    """Whether the decoder could end the process on damaged data, by the header of the table with the tiles."""
    kind = header.get("ZCMPTYPE")
    if kind not in _RICE:
        return kind in _DECODED_IN_C
    settings = {header.get(f"ZNAME{k}"): header.get(f"ZVAL{k}") for k in (1, 2)}
    block, pixel = settings.get("BLOCKSIZE", 32), settings.get("BYTEPIX", 4)
    if block not in _RICE_BLOCKS or pixel not in _RICE_PIXEL_BYTES:
        return True
    axes = range(1, header.get("ZNAXIS", 0) + 1)
    tile = [header.get(f"ZTILE{k}", header.get("ZNAXIS1", 1) if k == 1 else 1) for k in axes]
    return bool(math.prod(tile) * pixel > _RICE_TILE_BYTES)


def _chosen(hdus: HDUList, hdu: int | str | None, path: Path) -> tuple[int, tuple[str, ...]]:
    """Index of the image, and a note if there are several."""
    images = [k for k, each in enumerate(hdus) if each.is_image and each.header.get("NAXIS", 0) >= 2 and each.size]
    science = [k for k in images if hdus[k].name.upper() not in _QUALITY + _ERROR + _VARIANCE]
    if hdu is not None:
        try:
            number = int(hdu) if str(hdu).isdigit() else hdus.index_of(hdu)
        except KeyError:
            number = None
        if number not in images:
            have = ", ".join(f"{k} ({hdus[k].name or 'primary'})" for k in images) or "none"
            raise InputError(f"{path.name}: no image in extension {hdu}; images: {have}")
        return number, ()
    if not science:
        raise InputError(f"{path.name}: the file has no image of two dimensions, only {_contents(hdus)}")
    named = [k for k in science if hdus[k].name.upper() == "SCI"]
    first = (named or science)[0]
    if len(science) == 1:
        return first, ()
    others = ", ".join(f"{k} ({hdus[k].name or 'primary'})" for k in science if k != first)
    return first, (f"image: extension {first} ({hdus[first].name or 'primary'}) taken; also there: {others}",)


def _contents(hdus: HDUList) -> str:
    return ", ".join(f"{type(each).__name__} of {each.header.get('NAXIS', 0)} axes" for each in hdus)


def _companions(hdus: HDUList, chosen: int, shape: tuple[int, ...]) -> dict[str, Any]:
    """The error and quality planes of the image: same shape, same EXTVER."""
    planes: dict[str, Any] = {"quality": None, "sigma": None}
    for k, each in enumerate(hdus):
        name = each.name.upper()
        if k == chosen or not each.is_image or each.ver != hdus[chosen].ver or each.shape != shape:
            continue
        if name in _QUALITY:
            planes["quality"] = _quality(each.data, each.header)
        elif name in _ERROR:
            planes["sigma"] = each.data
        elif name in _VARIANCE:
            planes["sigma"] = np.sqrt(np.maximum(each.data, 0))
    return planes


def _quality(data: NDArray[Any], header: Header) -> PixelFlags:
    """Flags from a data-quality plane: any bit masks a pixel, unless the header defines the bits."""
    named = {key: flag for key, flag in _PLANES.items() if key in header}
    if not named:
        return np.where(data != 0, Flag.MASKED, 0).astype(np.uint16)
    flags = np.zeros(data.shape, np.uint16)
    for key, flag in named.items():
        if str(header[key]) not in map(str, range(64)):
            raise ValueError(f"{key} = {header[key]} is not the number of a bit")
        flags |= np.where(data & (1 << int(header[key])), flag, 0).astype(np.uint16)
    return flags


def _masked(mask: Any, shape: tuple[int, ...], name: str) -> PixelFlags:
    plane = np.asarray(mask)
    if plane.shape != shape:
        raise InputError(f"{name}: the mask has shape {plane.shape}, the image {shape}; give one of the same shape")
    return np.where(plane != 0, Flag.MASKED, 0).astype(np.uint16)


def _plane(values: Any, shape: tuple[int, ...], name: str, what: str) -> Image:
    plane = np.asarray(values, np.float32)
    if plane.shape != shape:
        raise InputError(f"{name}: {what} has shape {plane.shape}, the image {shape}; give one of the same shape")
    return plane


def _refuse_flat(values: NDArray[Any], facts: Facts, name: str) -> None:
    lowest, highest = values.min(), values.max()
    if lowest == highest:
        raise InputError(f"{name}: all pixels have the value {lowest}; the frame is empty or all saturated")
    share = float((values >= facts.saturation_adu).mean())
    if share > 0.5:
        raise InputError(
            f"{name}: {share:.0%} of the pixels are saturated (at {facts.saturation_adu:g} or above); "
            "nothing can be measured; check the exposure, or give the saturation level"
        )


# Parameters of the calibration of frames, all chosen.
HOT_SIGMAS = 8.0  # a pixel of the dark is hot above this many robust standard deviations from its surroundings
UNSTEADY = 0.05  # variation of hot pixels from frame to frame, as a share of their excess
DARKEST_FLAT = 0.2  # pixels of a flat below this sensitivity, relative to the median, are dead
SAME_EXPOSURE = 0.02  # relative difference within which exposures are equal


@dataclass(frozen=True)
class MasterFrames:
    """Master frames; make them with :meth:`MasterFrames.of`, apply them by ``masters(frame)``.

    bias, dark : (rows, columns) ADU or None; the dark includes the bias unless there is one.
    dark_exposure_s : exposure of the darks, NaN without them.
    flat : (rows, columns) sensitivity around 1, or None.
    excess : (rows, columns) ADU of hot pixels above their surroundings in the dark, 0 for others, or None.
    dead : (rows, columns) mask of the dead pixels of the flats, or None.
    """

    bias: FloatArray | None = None
    dark: FloatArray | None = None
    dark_exposure_s: float = math.nan
    flat: FloatArray | None = None
    excess: FloatArray | None = None
    dead: BoolArray | None = None

    @classmethod
    def of(
        cls, *, biases: Sequence[Frame] = (), darks: Sequence[Frame] = (), flats: Sequence[Frame] = ()
    ) -> MasterFrames:
        """Masters from frames of each kind; any may be missing.

        Raises InputError: frames of different shapes; darks of different exposures without a bias; a flat without
        light.
        """
        bias = _median(biases) if biases else None
        dark, exposure_s = (None, math.nan) if not darks else _dark(darks, bias, SAME_EXPOSURE)
        flat = None if not flats else _flat(flats, cls(bias=bias, dark=dark, dark_exposure_s=exposure_s))
        excess = None if dark is None else _excess(dark, HOT_SIGMAS)
        dead = None if flat is None else flat < DARKEST_FLAT
        shapes = {plane.shape for plane in (bias, dark, flat) if plane is not None}
        if len(shapes) > 1:
            raise InputError(
                f"calibration: bias, dark and flat have different shapes {sorted(shapes)}; use one binning"
            )
        return cls(bias, dark, exposure_s, flat, excess, dead)

    def __call__(self, frame: Frame) -> Frame:
        """The calibrated frame, with bad pixels flagged and a line in its facts for each step.

        Raises InputError: the masters have another shape.
        """
        for plane in (self.bias, self.dark, self.flat):
            if plane is not None and plane.shape != frame.shape:
                raise InputError(
                    f"{frame.name}: the frame has shape {frame.shape}, the calibration {plane.shape}; use one binning"
                )
        offset, lines = self._offset(frame)
        image = frame.image.astype(float) - offset
        if self.flat is not None:
            image, lines = image / np.maximum(self.flat, DARKEST_FLAT), (*lines, "divided by the flat")
        sigma = frame.sigma
        if sigma is not None and self.flat is not None:
            sigma = (sigma / np.maximum(self.flat, DARKEST_FLAT)).astype(np.float32)
        # Saturated pixels are flagged already; the level is reduced by what is subtracted.
        level = frame.facts.saturation_adu - float(np.median(offset))
        facts = replace(frame.facts, saturation_adu=level, pedestal_adu=0.0, lines=(*frame.facts.lines, *lines))
        result = replace(frame, image=image.astype(np.float32), sigma=sigma, facts=facts)
        if self.excess is not None:
            result = result.marked(_harmful(self.excess, result, UNSTEADY), Flag.HOT)
        return result if self.dead is None else result.marked(self.dead, Flag.MASKED)

    def _offset(self, frame: Frame) -> tuple[FloatArray, tuple[str, ...]]:
        """(rows, columns) ADU of bias, pedestal and dark current, and a line for each."""
        offset: FloatArray = np.zeros(frame.shape)
        lines: tuple[str, ...] = ()
        if self.bias is not None:
            offset, lines = offset + self.bias, ("bias subtracted",)
        if self.dark is None:
            if self.bias is None and frame.facts.pedestal_adu:
                return offset + frame.facts.pedestal_adu, ("pedestal subtracted",)
            return offset, lines
        ratio = frame.facts.exposure_s / self.dark_exposure_s
        if self.bias is not None and math.isfinite(ratio):
            done = (*lines, f"dark of {self.dark_exposure_s:g} s times {ratio:.3g} subtracted")
            return offset + self.dark * ratio, done
        lines += (f"dark of {self.dark_exposure_s:g} s subtracted",)
        if not abs(ratio - 1) < SAME_EXPOSURE:
            lines += (f"doubt: the frame has {frame.facts.exposure_s:g} s; without a bias its dark is not scaled",)
        return offset + self.dark, lines


def _median(frames: Sequence[Frame]) -> FloatArray:
    shapes = {frame.shape for frame in frames}
    if len(shapes) > 1:
        odd = next(frame for frame in frames if frame.shape != frames[0].shape)
        raise InputError(f"{odd.name}: its shape {odd.shape} is not that of {frames[0].name}, {frames[0].shape}")
    return np.asarray(np.median([frame.image for frame in frames], axis=0), float)


def _dark(darks: Sequence[Frame], bias: FloatArray | None, same_exposure: float) -> tuple[FloatArray, float]:
    exposures = np.array([frame.facts.exposure_s for frame in darks])
    if bias is None:
        if np.ptp(exposures) > same_exposure * exposures.max():
            raise InputError(
                f"{darks[0].name} and other darks: exposures from {exposures.min():g} to {exposures.max():g} s; "
                "give a bias, so that they can be scaled, or darks of one exposure"
            )
        return _median(darks), float(exposures[0])
    if not (exposures > 0).all():
        raise InputError(
            f"{darks[0].name} and other darks: an exposure is missing or zero; zero-second frames are biases"
        )
    if darks[0].shape != bias.shape:
        raise InputError(f"{darks[0].name}: its shape {darks[0].shape} is not that of the bias, {bias.shape}")
    longest = float(exposures.max())
    scaled = [(frame.image - bias) * (longest / s) for frame, s in zip(darks, exposures, strict=True)]
    return np.asarray(np.median(scaled, axis=0), float), longest


def _flat(flats: Sequence[Frame], dim: MasterFrames) -> FloatArray:
    """Sensitivity from flats and the masters without one: each is divided by its median, as the illumination varies."""
    normal = []
    for frame in flats:
        offset, _ = dim._offset(frame)
        image = frame.image - offset
        middle = float(np.median(image))
        if not middle > 0:
            raise InputError(f"{frame.name}: the flat has no signal above bias and dark; leave it out")
        normal.append(image / middle)
    return np.asarray(np.median(normal, axis=0), float)


def _excess(dark: FloatArray, hot_sigmas: float) -> FloatArray:
    """ADU of pixels above the median of their 5 × 5 surroundings, 0 within the noise; insensitive to amplifier glow."""
    from scipy.ndimage import median_filter

    excess = dark - median_filter(dark, 5, mode="reflect")
    return np.where(excess > max(hot_sigmas * robust_scale(excess), 1e-9), excess, 0.0)


def _harmful(excess: FloatArray, frame: Frame, unsteady: float) -> BoolArray:
    """Mask of the hot pixels whose noise, which remains after subtraction, is at least half of the frame's noise."""
    gain = frame.facts.gain_e_per_adu if math.isfinite(frame.facts.gain_e_per_adu) else 1.0
    step = np.diff(frame.image[:, ::2], axis=1)
    variance = robust_scale(step - np.median(step)) ** 2 / 2
    return np.asarray(excess / gain + (unsteady * excess) ** 2 > 0.25 * max(variance, 1e-12))
