"""The scene's problem for symforce: symbolic residuals, generated linearisations (in Python), its C++ optimiser.

Each kind of residual is generated once. symforce reads the annotations, so that they are not postponed here.
"""

from typing import Any

import numpy as np

from bench.scene import LAMBDA_MM, OF_PAIR, Scene
from fgreg.factors.point_on_line import COINCIDENCE_SIGMA_MM


def _beam_point(sf: Any, beam: Any, e: Any, lam: Any, data: dict[str, Any]) -> Any:
    """Camera point on a marker's beam, as :func:`bench.scene.aim_blocks` has it; without the misses."""
    chart = sf.V3(beam[2], beam[3], 1)
    unit = chart / chart.norm()
    nominal, origin = data["nominal_R"], data["nominal_p"]
    at = origin + nominal * sf.V3(beam[0], beam[1], 0) + (LAMBDA_MM * lam) * (nominal * unit)
    error = data["sigma"] * e
    w, u = sf.V3(error[0], error[1], error[2]), sf.V3(error[3], error[4], error[5])
    turn = sf.Rot3.from_tangent([w[0], w[1], w[2]], epsilon=sf.numeric_epsilon)
    w_u = w.cross(u)
    moved = u + w_u / 2 + w.cross(w_u) / 6
    return data["rotation"] * (turn * at + moved) + data["translation"]


def make_run(scene: Scene, tolerance: float) -> Any:
    """A function that solves the problem and returns the cost (chi square)."""
    import symforce

    if not symforce.__dict__.get("_epsilon_set", False):
        symforce.set_epsilon_to_number(1e-12)
        symforce.__dict__["_epsilon_set"] = True
    import sym
    import symforce.symbolic as sf
    from symforce.opt.factor import Factor
    from symforce.opt.numeric_factor import NumericFactor
    from symforce.opt.optimizer import Optimizer
    from symforce.values import Values

    def aim_residual(
        beam: sf.V4,
        e: sf.V6,
        lam: sf.Scalar,
        s: sf.V3,
        nominal_R: sf.M33,
        nominal_p: sf.V3,
        rotation: sf.M33,
        translation: sf.V3,
        sigma: sf.M66,
        spot: sf.V3,
        root: sf.M33,
    ) -> sf.Matrix:
        data = {
            "nominal_R": nominal_R,
            "nominal_p": nominal_p,
            "rotation": rotation,
            "translation": translation,
            "sigma": sigma,
        }
        point = _beam_point(sf, beam, e, lam, data)
        return sf.Matrix.block_matrix([[e], [s], [root * (point - COINCIDENCE_SIGMA_MM * s - spot)]])

    def pair_residual(
        pose: sf.Pose3,
        beam: sf.V4,
        edge: sf.Scalar,
        e: sf.V6,
        lam: sf.Scalar,
        s: sf.V3,
        d: sf.Scalar,
        nominal_R: sf.M33,
        nominal_p: sf.V3,
        rotation: sf.M33,
        translation: sf.V3,
        sigma: sf.M66,
        look: sf.V4,
        window: sf.V3,
        look_root: sf.M22,
        edge_unit: sf.Scalar,
    ) -> sf.Matrix:
        data = {
            "nominal_R": nominal_R,
            "nominal_p": nominal_p,
            "rotation": rotation,
            "translation": translation,
            "sigma": sigma,
        }
        point = pose * _beam_point(sf, beam, e, lam, data) - COINCIDENCE_SIGMA_MM * s
        scan, x_mm, heard, radius = look
        sine, cosine = sf.sin(scan), sf.cos(scan)
        across = cosine * point[1] - sine * point[2]
        outwards = sine * point[1] + cosine * point[2] - radius
        reach = sf.sqrt(across**2 + outwards**2)
        turn = d * COINCIDENCE_SIGMA_MM / heard
        delta = sf.atan2(across, outwards, epsilon=0) + turn
        rotation_off = sf.atan2(heard * sf.sin(delta), radius + heard * sf.cos(delta), epsilon=0)
        centre, gain, window_sigma = window
        miss = look_root * sf.V2(point[0] - x_mm, reach * sf.cos(turn) - heard)
        tangential = reach * sf.sin(turn) / COINCIDENCE_SIGMA_MM
        of_window = (rotation_off - centre - gain * edge_unit * edge) / window_sigma
        return sf.Matrix.block_matrix([[e], [s], [miss], [sf.V1(tangential)], [sf.V1(of_window)]])

    def edge_residual(edge: sf.Scalar) -> sf.V1:
        return sf.V1(edge)

    _, aims, pairs = scene.start()
    values = Values()
    pose = scene.trus_T_camera
    values["pose"] = sym.Pose3(R=sym.Rot3.from_rotation_matrix(pose[:3, :3]), t=pose[:3, 3])
    values["beam"], values["edge"] = np.zeros(4), 0.0
    values["nominal_R"], values["nominal_p"] = scene.marker_T_nominal[:3, :3], scene.marker_T_nominal[:3, 3]
    values["edge_unit"] = scene.edge_sigma_rad
    factors, optimized = [], ["pose", "beam", "edge"]
    generated: dict[str, Any] = {}

    def add_factor(residual: Any, keys: list[str], count: int) -> None:
        """A factor on keys, of which all but the last ``count`` are variables."""
        variables = keys[: len(keys) - count]
        if residual.__name__ not in generated:
            symbolic = Factor(residual=residual, keys=keys)
            generated[residual.__name__] = symbolic.to_numeric_factor(variables).linearization_function
        factors.append(NumericFactor(keys, variables, generated[residual.__name__]))

    def add_private(name: str, private: Any, place: int) -> None:
        values[f"e{name}"], values[f"s{name}"] = private[:6].copy(), private[7:10].copy()
        values[f"lam{name}"] = float(private[6])
        values[f"rotation{name}"], values[f"translation{name}"] = scene.rotation[place], scene.translation_mm[place]
        values[f"sigma{name}"] = scene.marker_sigma[place]
        optimized.extend([f"e{name}", f"lam{name}", f"s{name}"])

    common = ("nominal_R", "nominal_p")
    for i, private in enumerate(aims):
        name = f"_a{i}"
        add_private(name, private, i)
        values[f"spot{name}"], values[f"root{name}"] = scene.spot_mm[i], scene.spot_root[i]
        of_shot = [f"{key}{name}" for key in ("rotation", "translation", "sigma", "spot", "root")]
        keys = ["beam", f"e{name}", f"lam{name}", f"s{name}", *common, *of_shot]
        add_factor(aim_residual, keys, 7)
    for i, private in enumerate(pairs):
        assert len(private) == OF_PAIR
        name = f"_p{i}"
        add_private(name, private, scene.aims + i)
        values[f"d{name}"] = float(private[10])
        optimized.append(f"d{name}")
        values[f"look{name}"] = np.array([scene.scan_rad[i], scene.x_mm[i], scene.range_mm[i], scene.radius_mm])
        values[f"window{name}"] = np.array([scene.centre_rad[i], scene.edge_gain[i], scene.sigma_rad[i]])
        values[f"look_root{name}"] = scene.look_root[i]
        own = [f"{key}{name}" for key in ("e", "lam", "s", "d")]
        of_shot = [f"{key}{name}" for key in ("rotation", "translation", "sigma", "look", "window", "look_root")]
        keys = ["pose", "beam", "edge", *own, *common, *of_shot, "edge_unit"]
        add_factor(pair_residual, keys, 9)
    add_factor(edge_residual, ["edge"], 0)
    params = Optimizer.Params(verbose=False, early_exit_min_reduction=tolerance, iterations=200)
    optimizer = Optimizer(factors=factors, optimized_keys=optimized, params=params)

    def run() -> float:
        return 2.0 * float(optimizer.optimize(values).error())

    return run
