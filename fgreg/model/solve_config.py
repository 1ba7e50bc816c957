"""Settings of a solve; invalid values raise, they are never repaired."""

import math
from dataclasses import dataclass
from typing import Annotated

from fgreg.schema.kinds import Number
from fgreg.schema.record import Key


@dataclass(frozen=True, slots=True)
class SolveConfig:
    """Settings of the estimate and of its verdict, which is refused beyond twice ``limit_mm``.

    Attributes:
        limit_mm: predicted 95 % error at the worst target up to which the verdict is ``ok``.
        second_minimum_chi2: two minima whose costs differ by less are ambiguous (99 % of chi square, 2 dof).
        min_pairs: with fewer pairs the registration counts as undetermined unless the session gives an initial one.
        refuse_beam_spread_rad, warn_beam_spread_rad: root mean square angle of the beams about their mean direction.
        refuse_spot_spread_mm, warn_spot_spread_mm: root mean square distance of the PMs from their best line.
        min_sweeps_per_side: with fewer sweeps from one side a session with first hits counts as one-way.
        window_shape: use the sensitivity window's own shape, an interval, and amplitudes by the sensitivity curve;
            False: a Gaussian of the same mean and variance, and no amplitudes.
        amplitude_sigma: relative noise of amplitudes.
        estimate_sound_speed, estimate_radius: make these variables, with the priors that follow.
        sound_speed_sigma: prior of the ratio of true to assumed sound speed, about 1.
        radius_sigma_mm: prior of the probe's radius, about the session's.
        posterior_effective: effective number of independent posterior samples to reach.
        posterior_samples: largest number of draws; sampling then stops with fewer effective samples.
        posterior_looks: with more looks than this the posterior is taken as the Gaussian at the optimum.
        seed: of those draws.
        certificate_budget: work at most for a proof that no other registration explains the pairs, as cells of
            rotations times PMs (3 to 8 us each); 0: no proof.
    """

    limit_mm: Annotated[
        float,
        Key(
            "predicted 95 % error at the worst target up to which the verdict is ok",
            Number(0.0, 100.0, above=True, unit="mm"),
        ),
    ] = 3.0
    second_minimum_chi2: float = 9.2
    min_pairs: int = 6
    refuse_beam_spread_rad: float = math.radians(2.0)
    warn_beam_spread_rad: float = math.radians(5.0)
    refuse_spot_spread_mm: float = 2.0
    warn_spot_spread_mm: float = 4.0
    min_sweeps_per_side: int = 3
    window_shape: bool = True
    amplitude_sigma: float = 0.05
    estimate_sound_speed: bool = False
    estimate_radius: bool = False
    sound_speed_sigma: float = 0.03
    radius_sigma_mm: float = 0.3
    posterior_effective: float = 300.0
    posterior_samples: int = 4500
    posterior_looks: int = 80
    seed: int = 1
    certificate_budget: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.limit_mm) and self.limit_mm > 0):
            raise ValueError(f"limit_mm is {self.limit_mm}, expected a number > 0")
        if self.posterior_samples < 100:
            raise ValueError(f"posterior_samples is {self.posterior_samples}, expected at least 100")
        if self.certificate_budget < 0:
            raise ValueError(f"certificate_budget is {self.certificate_budget}, expected at least 0")
        for name in ("amplitude_sigma", "sound_speed_sigma", "radius_sigma_mm", "posterior_effective"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}, expected a number > 0")
