"""Light through blood: absorption by haemoglobin, after Beer and Lambert.

A film of thickness d on something white is passed twice, so that a band keeps exp(-2 mu d) of its light. mu of whole
blood (150 g/l, 75 % oxygenated), from the molar extinctions that S. Prahl tabulates (omlc.org, "Optical absorption of
hemoglobin"): mu = 2.303 e c / 64,500 g/mol, means over 450 to 500, 500 to 580 and 600 to 680 nm. Scattering in the film
is left out: it would make thick films a little brighter.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray

PER_MM: FloatArray = np.array([18.0, 20.0, 1.2])
"""mu of blue, green, red, 1/mm."""
LUMA: FloatArray = np.array([0.114, 0.587, 0.299])
"""Share of blue, green, red in a grey picture (ITU-R BT.601)."""


def transmission(thickness_mm: npt.NDArray[np.floating], colours: int) -> list[npt.NDArray[np.float32]]:
    """What a film leaves of the light, for each of 3 ``colours`` (blue, green, red), or for 1, which is grey."""
    thickness = np.asarray(thickness_mm, dtype=np.float32)
    left = [np.exp(np.float32(-2.0 * mu) * thickness) for mu in PER_MM]
    if colours == 3:
        return left
    return [np.asarray(sum(np.float32(share) * band for share, band in zip(LUMA, left, strict=True)))]
