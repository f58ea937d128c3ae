"""Fitting score maps and evidence weights by penalised maximum likelihood; everything deterministic and on arrays."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.fusion.calibration import ScoreMap, Transform, natural_transform, transform_scores
from lcf3d.fusion.evidence import Evidence, to_probability
from lcf3d.structures import FloatArray, IntArray

# an isotonic map is taken only where it lowers the cross-validated log loss by this share: its steps need data
ISOTONIC_GAIN = 0.02
# a block of equal probability of an isotonic map holds at least so many detections
ISOTONIC_BLOCK = 20
# pull of the evidence weights towards those of the LiDAR branch alone, in detections
EVIDENCE_STRENGTH = 20.0


def log_loss(probabilities: FloatArray, right: FloatArray) -> float:
    """Mean negative log-likelihood of 0/1 outcomes, in nats; probabilities are kept 1e-6 from 0 and 1."""
    p = np.clip(probabilities, 1e-6, 1 - 1e-6)
    return float(-np.mean(right * np.log(p) + (1 - right) * np.log1p(-p))) if len(p) else float("nan")


def fit_platt(
    x: FloatArray, right: FloatArray, prior: tuple[float, float] = (1.0, 0.0), strength: float = 1.0
) -> tuple[float, float]:
    """Slope and intercept of log-odds that are a rising straight line in ``x``.

    Args:
        x: (N,) transformed scores.
        right: (N,) 1 or 0.
        prior: slope and intercept without data.
        strength: weight of the prior, in detections.
    """
    if not len(x):
        return prior
    middle, spread = float(x.mean()), max(float(x.std()), 1e-3)
    start = np.array([prior[0] * spread, prior[1] + prior[0] * middle])
    columns = np.stack([(x - middle) / spread, np.ones(len(x))], axis=1)
    tilt, level = minimise_log_loss(columns, right, start, np.full(2, strength / 4), np.array([1e-3 * spread, -np.inf]))
    return tilt / spread, level - tilt * middle / spread


def fit_isotonic(x: FloatArray, right: FloatArray, slope: float) -> tuple[tuple[float, float], ...]:
    """Rising points (transformed score, log-odds) of an isotonic regression.

    Equal-probability blocks of fewer than ``ISOTONIC_BLOCK`` detections are joined with the next; each becomes a point
    at its mean score. Log-odds are those of ``(right + 1/2) / (count + 1)``.

    Args:
        x: (N,) transformed scores, at least one.
        right: (N,) 1 or 0.
        slope: least slope between points, so that the order of scores is never lost: a hundredth of it.
    """
    from scipy.optimize import isotonic_regression

    order = np.argsort(x, kind="stable")
    sorted_x, sorted_right = x[order], right[order]
    blocks = list(isotonic_regression(sorted_right).blocks)
    bounds = [0]
    for end in blocks[1:]:
        if end - bounds[-1] >= ISOTONIC_BLOCK:
            bounds.append(int(end))
    if len(bounds) > 1 and blocks[-1] - bounds[-1] < ISOTONIC_BLOCK:
        bounds.pop()
    bounds.append(len(x))
    if len(bounds) > 2 and bounds[-1] == bounds[-2]:
        bounds.pop()
    points: list[tuple[float, float]] = []
    for low, high in pairwise(bounds):
        count, hits = high - low, float(sorted_right[low:high].sum())
        at, value = float(sorted_x[low:high].mean()), float(np.log((hits + 0.5) / (count - hits + 0.5)))
        if points and at <= points[-1][0]:
            continue
        least = points[-1][1] + slope / 100 * (at - points[-1][0]) if points else -np.inf
        points.append((at, max(value, least)))
    return tuple(points)


def fit_map(scores: FloatArray, right: FloatArray, kind: str, transform: Transform) -> ScoreMap:
    """A score map of the given kind and transform."""
    x = transform_scores(scores, transform)
    slope, intercept = fit_platt(x, right)
    if kind == "isotonic" and len(x):
        return ScoreMap(kind="isotonic", transform=transform, slope=slope, points=fit_isotonic(x, right, slope))
    return ScoreMap(transform=transform, slope=slope, intercept=intercept)


def choose_map(scores: FloatArray, right: FloatArray, folds: IntArray) -> tuple[ScoreMap, float]:
    """The score map of least cross-validated log loss, fitted on all, and that log loss.

    Candidates are Platt lines on the score as it is, on its natural transform, and an isotonic map.

    Args:
        scores: (N,) scores, at least one.
        right: (N,) 1 or 0.
        folds: (N,) fold of each detection.
    """
    natural = natural_transform(scores)
    candidates: list[tuple[str, Transform]] = [("platt", natural)]
    if natural != "identity":
        candidates.append(("platt", "identity"))
    candidates.append(("isotonic", natural))
    losses = [_cross_validated(scores, right, folds, kind, transform) for kind, transform in candidates]
    best = int(np.argmin(losses[:-1]))
    if losses[-1] < losses[best] * (1 - ISOTONIC_GAIN):
        best = len(candidates) - 1
    return fit_map(scores, right, *candidates[best]), losses[best]


def _cross_validated(scores: FloatArray, right: FloatArray, folds: IntArray, kind: str, transform: Transform) -> float:
    held_out = np.empty(len(scores))
    for fold in np.unique(folds):
        test = folds == fold
        held_out[test] = fit_map(scores[~test], right[~test], kind, transform)(scores[test])
    return log_loss(held_out, right)


def fit_evidence(
    table: FloatArray, right: FloatArray, strength: float = EVIDENCE_STRENGTH, recovered: float = 0.4
) -> Evidence:
    """Evidence weights of a class, none negative, by maximum likelihood with a pull towards the LiDAR branch alone.

    Args:
        table: (N, 9) see `lcf3d.fusion.evidence.evidence_table`.
        right: (N,) 1 where the box is a true positive, 0 where it is a false one.
        strength: of the pull, see ``EVIDENCE_STRENGTH``; the constant is free.
        recovered: handed through, see `Evidence`.
    """
    if table.shape != (len(right), len(Evidence.lidar_alone().weights)):
        raise ConfigError(f"evidence table must have shape ({len(right)}, 9), got {table.shape}")
    scale = np.sqrt((table**2).mean(axis=0)) if len(table) else np.ones(9)
    scale[scale < 1e-9] = 1.0
    start = Evidence.lidar_alone().weights * scale
    pull = np.full(9, strength)
    pull[[0, -1]] = 0.01
    lowest = np.zeros(9)
    lowest[-1] = -np.inf
    weights = minimise_log_loss(table / scale, right, start, pull, lowest) / scale
    # a LiDAR weight of nothing would leave the order of its boxes to chance
    weights[0] = max(weights[0], 0.05)
    return Evidence.from_weights(np.round(weights, 4).astype(np.float64), recovered)


def minimise_log_loss(
    columns: FloatArray,
    right: FloatArray,
    start: FloatArray,
    pull: FloatArray,
    lowest: FloatArray,
    offset: FloatArray | float = 0.0,
) -> FloatArray:
    """(K,) weights of a logistic regression with a quadratic pull towards ``start`` and lower bounds.

    Args:
        columns: (N, K) what is known of each case.
        right: (N,) 1 or 0.
        start: (K,) weights without data.
        pull: (K,) how strongly they pull.
        lowest: (K,) bounds.
        offset: (N,) log-odds that are given.
    """
    from scipy.optimize import minimize

    def objective(weights: FloatArray) -> tuple[float, FloatArray]:
        log_odds = columns @ weights + offset
        away = weights - start
        loss = np.logaddexp(0, log_odds) - right * log_odds
        gradient = columns.T @ (to_probability(log_odds) - right) + pull * away
        return float(loss.sum() + 0.5 * (pull * away**2).sum()), gradient

    begin = np.maximum(start, lowest)
    found = minimize(
        objective, begin, jac=True, method="L-BFGS-B", bounds=[(low, None) for low in lowest], options={"maxiter": 1000}
    )
    return np.asarray(found.x, dtype=np.float64)


def block_folds(frame_ids: tuple[str, ...], count: int) -> IntArray:
    """(F,) fold of every frame: whole sequences where ids read ``SEQUENCE_FRAME``, else blocks of consecutive frames.

    Sequences are dealt out by falling number of frames, each to the fold with the fewest so far. Frames of one
    sequence look alike: splitting them would flatter every figure.

    Raises:
        ConfigError: fewer than two folds, or fewer frames (sequences) than folds.
    """
    if count < 2:
        raise ConfigError(f"cross-validation needs 2 folds or more, got {count}")
    sequences = [name.rpartition("_")[0] for name in frame_ids]
    if all(sequences) and len(set(sequences)) > 1:
        names, index, sizes = np.unique(np.array(sequences), return_inverse=True, return_counts=True)
        if len(names) < count:
            raise ConfigError(f"there are {len(names)} sequences for {count} folds; use --folds {len(names)} or fewer")
        of_sequence, load = np.zeros(len(names), dtype=np.int64), np.zeros(count, dtype=np.int64)
        for sequence in np.argsort(-sizes, kind="stable"):
            of_sequence[sequence] = load.argmin()
            load[load.argmin()] += sizes[sequence]
        return of_sequence[index]
    if len(frame_ids) < count:
        raise ConfigError(f"there are {len(frame_ids)} frames for {count} folds; use --folds {len(frame_ids)} or fewer")
    return np.asarray(np.arange(len(frame_ids)) * count // len(frame_ids), dtype=np.int64)
