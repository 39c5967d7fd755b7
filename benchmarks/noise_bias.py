"""What isotropic noise does to the distances of a cloud from a round surface, and by it to the forces.

    python benchmarks/noise_bias.py [--draws 20]

At the truth of frames 0, 2, ... 8 of s1, s2, s3 of the public liver: the mean signed distance of noisy clouds, and the
mean step of the net force that the linear response then asks for, along the true force and in its deviations (Tukey's
weights; coefficients expected at 0.05 N, as clear clouds find them). Without and with what `expected_distance`
takes off: nothing is found there that the true state has not, so a mean other than 0 is bias.
"""

from __future__ import annotations

import numpy as np
from harness import Benchmark, Given, Setting, run
from liver import SEQUENCES, sequence
from robustness import forward_model, noisy, registrar_for

from softtwin.registration.loss import Tukey
from softtwin.registration.surface_distance import expected_distance

EXPECTED_N = 0.05
NOISES_MM = (1.0, 2.0, 5.0)


def measure(name: str, draws: int) -> list[dict[str, float]]:
    """One entry for each noise and each kind of residual of a sequence."""
    data = sequence(name)
    rows: dict[tuple[float, bool], list[tuple[float, float]]] = {
        (mm, taken): [] for mm in NOISES_MM for taken in (False, True)
    }
    with forward_model("reference", None) as model:
        registrar = registrar_for(model, data.zone, True)
        observed, net = registrar.observed, registrar.forces.net_basis
        for frame in range(0, 10, 2):
            state = registrar.register(data.clouds[frame]).evaluation.state
            truth = (data.positions[frame] - model.body.points)[observed.nodes]
            along = data.net_forces[frame] / np.linalg.norm(data.net_forces[frame])
            for mm, taken in rows:
                for draw in range(draws):
                    cloud = noisy(mm)(data.clouds[frame], model.body, np.random.default_rng([draw, frame, int(mm)]))
                    match = observed.match(truth, cloud)
                    expected = expected_distance(observed.curvature(match), 1e-3 * mm)
                    residuals = match.distances - (expected if taken else 0.0)
                    jacobian = state.jacobian(observed.rows(match)) / (1e-3 * mm)
                    weighted = Tukey().weight(residuals / (1e-3 * mm))[:, None] * jacobian
                    covariance = np.linalg.inv(weighted.T @ jacobian + np.eye(jacobian.shape[1]) / EXPECTED_N**2)
                    step = -net @ covariance @ (weighted.T @ residuals) / (1e-3 * mm)
                    deviation = float(np.sqrt(along @ net @ covariance @ net.T @ along))
                    rows[mm, taken].append((1e3 * residuals.mean(), float(step @ along) / deviation))
    return [
        {"noise_mm": mm, "is_taken_off": taken, "mean_residual_mm": found[0], "mean_step_deviations": found[1]}
        for (mm, taken), found in ((key, np.mean(value, axis=0).tolist()) for key, value in rows.items())
    ]


def work(row: str, given: Given) -> list[dict[str, float]]:
    return measure(row, given.draws)


BENCHMARK = Benchmark(
    name="noise_bias",
    title="What isotropic noise does to the distances of a cloud from a round surface, and by it to the forces",
    about=("registration",),
    work=work,
    rows=SEQUENCES,
    settings={"draws": Setting(20, "of each cloud")},
    small={"draws": 1},
    under="sequences",
    finish=lambda figures, given: {"draws": given.draws},
)


if __name__ == "__main__":
    run(BENCHMARK)
