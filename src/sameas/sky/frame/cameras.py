"""What cameras write that is no plain frame: photographs, colour filters over single pixels, wrapped numbers.

- :func:`photograph` reads JPEG, PNG and TIFF.
- :func:`unwrapped` repairs unsigned numbers that were stored as signed.
- :func:`even_mosaic` brings the four kinds of pixels behind a mosaic of filters (Bayer) to one sky and one response.
  Each kind of a square of 2 × 2 pixels sees another part of the spectrum, so that the sky is a pattern of levels, which
  hides faint stars as noise would, and a star loses light where its pixels are of a kind that sees little of it. Kinds
  are compared by what they share: stars fall on all of them alike, so that quantiles of their pixels above the sky
  differ by their response only. On a simulated frame of a small telescope, with responses of 0.5 to 1, this gains
  2.5 mag of depth. Pixels are not interpolated, which would correlate their noise.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, robust_scale
from sameas.errors import InputError, first_line, optional

if TYPE_CHECKING:
    from astropy.io.fits import Header

#: Suffixes of photographs.
PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
#: Tags of EXIF, and of its folder of the exposure.
_EXIF, _TAKEN, _ZONE, _SECONDS = 0x8769, 0x9003, 0x9011, 0x829A


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


# Parameters of the mosaic, all chosen.
#: Levels of the kinds that differ by more than this share of the noise of a pixel are those of a mosaic.
LEVELS_APART = 0.3
#: Brightest pixels of a kind by which its response is measured, as quantiles; they are above the sky by this many times
#: its noise.
BRIGHTEST, ABOVE_SKY = np.linspace(0.99, 0.9995, 20), 8.0
#: Largest ratio of two responses; a larger one is not that of a filter.
UNLIKE = 20.0
#: Side of the boxes in which the level of the sky is measured, pixels.
BOX_PX = 64


def even_mosaic(image: NDArray[Any], usable: BoolArray) -> tuple[NDArray[Any], FloatArray] | None:
    """The image with one level and one response of all pixels, and the responses; None if it is no mosaic.

    image : (rows, columns). usable : (rows, columns) mask of the pixels that are compared. The responses are those of
    the first and second pixel of even rows and of odd rows, the largest 1.
    """
    kinds, used = ([plane[y::2, x::2] for y in (0, 1) for x in (0, 1)] for plane in (image, usable))
    if min(int(mask.sum()) for mask in used) < BOX_PX**2:
        return None
    boxes = tuple(max(1, length // BOX_PX) for length in image.shape)
    skies = [_sky(kind, boxes) for kind in kinds]
    above = [(kind - _spread(sky, kind.shape))[mask] for kind, sky, mask in zip(kinds, skies, used, strict=True)]
    noise = np.array([robust_scale(values) for values in above])
    if not np.ptp([np.median(sky) for sky in skies]) > LEVELS_APART * float(noise.min()) > 0:
        return None
    response = _responses(above, noise)
    even = [sky / each for sky, each in zip(skies, response, strict=True)]
    middle = np.mean(even, axis=0)
    result = image.copy()
    for number, (kind, sky, each) in enumerate(zip(kinds, even, response, strict=True)):
        result[number // 2 :: 2, number % 2 :: 2] = kind / each - _spread(sky - middle, kind.shape)
    return result, response


def _responses(above: list[FloatArray], noise: FloatArray) -> FloatArray:
    """(4,) responses to the light of stars, the largest 1; all 1 where too few stars tell.

    above : values of each kind above its sky. noise : (4,) their noise.
    """
    bright = np.array([np.quantile(values, BRIGHTEST) for values in above])
    seen = (bright > ABOVE_SKY * noise[:, None]).all(axis=0)
    if not seen.any():
        return np.ones(len(above))
    ratio = np.median(bright[:, seen] / bright[:, seen].max(axis=0), axis=1)
    ratio /= ratio.max()
    return ratio if ratio.min() > 1.0 / UNLIKE else np.ones(len(above))


def _sky(kind: NDArray[Any], boxes: tuple[int, ...]) -> FloatArray:
    """Medians of this number of boxes along each axis; the last ones are larger."""
    side = BOX_PX // 2
    rows, columns = (np.arange(1, count) * side for count in boxes)
    return np.array([[np.median(box) for box in np.split(band, columns, axis=1)] for band in np.split(kind, rows)])


def _spread(boxes: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Values of boxes on all pixels, linear between their middles."""
    from scipy.ndimage import map_coordinates

    y, x = (
        np.clip((np.arange(length) + 0.5) / (BOX_PX // 2) - 0.5, 0, count - 1)
        for length, count in zip(shape, boxes.shape, strict=True)
    )
    return np.asarray(map_coordinates(boxes, np.meshgrid(y, x, indexing="ij"), order=1))
