"""Fits the probabilities of being right: prints the numbers by their names in the
calibration.py of their rooms.

    python tools/calibrate.py --data ../shared/data
    python tools/calibrate.py --data ../shared/data --weights pwvo.safetensors

Pairs of the makers of tools/maker_pairs.py that are for calibration, of which the training saw
none, and scenes in which no part follows the camera. Each maker counts alike, however many
pairs it has. Right is what tools/bench/semi_real.py calls so. What is printed of a maker is by a
fit on all others.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bench.methods import heavy_pairs
from bench.semi_real import (
    SEEDS,
    calibration_error,
    models_of,
    static_part,
)
from known_pairs import HEAVY
from maker_pairs import CALIBRATION, FILMS, WITHOUT_FLOW, Film, Maker
from measuring import add_workers, ego_flow_error, parser_of
from scipy.optimize import minimize
from scipy.special import expit, logsumexp

from hybridvo import Odometry, dis_flow, iter_pairs, open_sequence, refine
from hybridvo.core.belief import Belief
from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.geometry import invert, pose_matrix
from hybridvo.core.results import StageFailed
from hybridvo.core.types import FramePair
from hybridvo.evidence.pair import PairEvidence
from hybridvo.flow.providers import with_flow
from hybridvo.hypotheses.cues import Cues, compute_cues
from hybridvo.hypotheses.select import (
    cue_candidates,
    to_hypotheses,
)
from hybridvo.io.data.truth import true_motion
from hybridvo.judge.calibration import CERTAINTY_BONUS, DIRECT_PROBABILITY
from hybridvo.network.models import Models
from hybridvo.pipeline import Context, by_flow, run_method, sure_alignment
from hybridvo.solver.align import align_images
from hybridvo.solver.aligned_points import RememberedEvidence
from hybridvo.tracking.memory import carried_to
from hybridvo_lab.calibration import WRONG_PX
from hybridvo_lab.synthetic.noise_scenarios import SCENARIOS, make_pair
from hybridvo_lab.synthetic.training_scenes import undetermined_pair
from hybridvo_lab.training.validation import allowed_error_px, area_under_curve

HEAVY_SEEDS = range(900, 906)
"""Seeds of the heavy development scenes."""
STATIC = (
    "tum/rgbd_dataset_freiburg1_xyz_first10",
    "tum/redwood_livingroom_5",
    "real_static/rooms_110",
)
"""Static recordings, for the direct motion."""
UNRELATED_FRAMES = 5
"""Frames of each static recording that are paired with unrelated images."""
UNDETERMINED_EVERY = 5
"""A scene in which no part follows the camera for so many pairs of a maker."""
TINY = 1e-9
"""What keeps a logarithm finite."""
RIDGE = 1e-3
"""Penalty on the squared slopes of evidence of unit variance, times the number of answers."""
CUES_RIGHT_RIDGE = 1e-4
"""The same for the answers by cues."""
CUE_RIDGE = 0.02
"""The same for the weights of the cues."""
SCENARIO_SEEDS = range(500, 512)
"""Seeds of the noise scenarios on which the cues are fitted."""
CUES = "CUES_RIGHT"
"""Answers by cues; these and the next names are those of the numbers that are fitted."""
CHOICE = "CHOICE_RIGHT"
"""Motions chosen among all that were found, after each flow."""
DIRECT = "DIRECT_EXACT, DIRECT_OF_SCENE"
"""Direct motions: that they are exact, and that they are the scene's."""
RIGHT_DIRECT = 0.25 / 320
"""Error up to which a direct motion is right at any rate, fraction of the image's width: at video
rate one between the motions of several things errs by hardly more."""
NO_BELIEF = np.nan
"""In place of a belief's certainty, where all of the view was asked."""
POINTS = 1500
"""Points of a film's frame, about, on which the error of a motion is measured."""
DIRECT_STARTS = ((-1.0, 1.0, 1.0), (-0.5, 2.0, 1.0), (0.0, 1.0, 2.0))
"""Slopes and the two constants from which that fit starts."""


class Case(NamedTuple):
    """A pair with its ground truth."""

    pair: Any
    T_curr_prev: np.ndarray
    depth: np.ndarray  # (H, W) of the static pixels, metres
    oracle_px: float  # error of the fit inside the true static mask
    maker: str = ""

    def error_px(self, T: np.ndarray) -> float:
        """Error of a motion (4, 4)."""
        return ego_flow_error(T, self.T_curr_prev, self.depth, self.pair)


class Answer(NamedTuple):
    """An answer whose probability is fitted."""

    name: str  # of the number
    # of a direct motion with the certainty of the belief at its end
    evidence: tuple[float, ...]
    error_px: float


class Labelled(NamedTuple):
    """Evidence of an answer, and whether it was right."""

    evidence: tuple[float, ...]
    is_right: bool
    maker: str = ""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--pairs", type=int, default=200, help="of makers without a fixed number")
    add("--cues", action="store_true", help="fit the weights of the cues alone")
    add("--direct", action="store_true", help="fit the direct motions alone")
    add("--choice", action="store_true", help="fit the choices of PWVO alone")
    add("--weights", metavar="FILE", help="of PWVO, in place of the shipped ones")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add(
        "--numbers",
        metavar="A,B",
        help="try every other number with one of these in its name; ALL: all",
    )
    add("--out", type=Path, metavar="FILE", help="of --numbers")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if args.cues:
        print(cue_weights(args))
        return 0
    if args.numbers:
        from number_fits import fit_numbers

        return fit_numbers(args, argv)
    models = models_of(args.weights)
    rows: dict[str, list[Labelled]] = {}

    def keep(case: Case, given: Iterator[Answer]) -> None:
        for name, evidence, error_px in given:
            least_px = WRONG_PX
            if name == DIRECT:
                least_px = RIGHT_DIRECT * case.pair.prev.camera.width
            limit = allowed_error_px(case.oracle_px, least_px)
            row = Labelled(evidence, error_px <= limit, case.maker)
            rows.setdefault(name, []).append(row)

    if args.choice:
        for case in development_cases(args):
            keep(case, chosen_answers(case, models))
        report(CHOICE, rows[CHOICE])
        return 0
    for case in cases_of(CALIBRATION, args):
        keep(case, direct_answers(case))
        if not args.direct:
            keep(case, answers(case, models))
    for case in static_cases(args.data):
        keep(case, direct_answers(case))
        if not args.direct:
            keep(case, cue_answers(case))
    for case in cases_of(WITHOUT_FLOW, args):
        keep(case, direct_answers(case))
    for maker, films in FILMS.items():
        for film in films(args.data):
            for case, answer in remembered_answers(film, maker):
                keep(case, iter([answer]))
    if not args.direct:
        for case in undetermined_cases(args):
            keep(case, answers(case, models))
        for case in chain(scenario_cases(), unrelated_cases(args.data)):
            keep(case, cue_answers(case))
    for name, labelled in rows.items():
        report(name, labelled)
    return 0


# --- pairs ------------------------------------------------------------------------


def development_cases(args: argparse.Namespace) -> Iterator[Case]:
    """Pairs of all makers for calibration, and scenes in which no part follows the camera."""
    return chain(cases_of(CALIBRATION, args), undetermined_cases(args))


def cases_of(makers: dict[str, Maker], args: argparse.Namespace) -> Iterator[Case]:
    """Pairs of some makers."""
    for maker, pairs in makers.items():
        for drawn in pairs(args.data, args.pairs):
            if drawn.pair.flow is None:
                continue
            static = static_part(drawn)
            yield Case(
                drawn.pair, drawn.T_curr_prev, static.depth, static.oracle_px, maker
            )


def undetermined_cases(args: argparse.Namespace) -> Iterator[Case]:
    """Scenes in which no part follows the camera."""
    for k in range(args.pairs // UNDETERMINED_EVERY):
        rng = np.random.default_rng([SEEDS["development"], k])
        other = undetermined_pair(rng, 218, 512)
        yield Case(other.pair, other.T_curr_prev, other.depth, 0.0, "undetermined")


def heavy_cases(flow: str) -> Iterator[Case]:
    """The heavy development scenes with one of their flows."""
    for kind in HEAVY:
        for seed in HEAVY_SEEDS:
            for case in heavy_pairs(kind, seed):
                if case.flow == flow:
                    depth = case.pair.prev.depth
                    yield Case(case.pair, case.T_curr_prev, depth, 0.0)


def static_cases(data: Path) -> Iterator[Case]:
    """Neighbouring frames of static recordings that are in no test."""
    for name in STATIC:
        sequence = open_sequence(data / name)
        for k, pair in enumerate(iter_pairs(sequence, dis_flow())):
            T = true_motion(sequence, k, k + 1)
            if T is None or pair.flow is None:
                continue
            case = Case(pair, T, pair.prev.depth, 0.0, f"static, {name}")
            oracle_px = case.error_px(refine(pair).T_curr_prev)
            yield case._replace(oracle_px=oracle_px)


def scenario_cases() -> Iterator[Case]:
    """Pairs of the noise scenarios."""
    for name in SCENARIOS:
        for seed in SCENARIO_SEEDS:
            pair, truth = make_pair(name, seed)
            yield Case(pair, truth["T_curr_prev"], truth["depth_true"], 0.0)


def unrelated_cases(data: Path) -> Iterator[Case]:
    """Pairs of images that have nothing in common: no motion is right, none is near."""
    rng = np.random.default_rng(5)
    nowhere = pose_matrix(np.eye(3, 4))
    nowhere[2, 3] = 1e3
    for name in STATIC:
        sequence = open_sequence(data / name)
        for index in range(min(len(sequence), UNRELATED_FRAMES)):
            frame = sequence[index]
            noise = rng.integers(0, 255, frame.rgb.shape, dtype=np.uint8)
            for rgb in (255 - frame.rgb, noise):
                bare = FramePair(frame, replace(frame, rgb=rgb), None)
                pair = with_flow(bare, dis_flow())
                if pair.flow is not None:
                    yield Case(pair, nowhere, frame.depth, 0.0)


# --- answers ----------------------------------------------------------------------


def direct_answers(case: Case) -> Iterator[Answer]:
    """The direct motions, sure or not, from the identity, from the truth, and from two motions of
    the search, which may be those of things.
    """
    starts = [None, case.T_curr_prev]
    motions = search_of(Context().evidence(case.pair))
    if motions is not None:
        starts += [pose_matrix(pose) for pose in motions.poses[-2:]]
    for start in starts:
        direct = sure_alignment(align_images(case.pair, start), 0.0)
        if direct is not None:
            error_px = case.error_px(direct.T_curr_prev)
            yield Answer(DIRECT, (*direct.evidence, NO_BELIEF), error_px)


def remembered_answers(film: Film, maker: str) -> Iterator[tuple[Case, Answer]]:
    """The direct motions of a film, from where a tracker starts, by what it believes static."""
    tracker = Odometry()
    for k, frame in enumerate(film.frames):
        memory = tracker.state.memory
        newest = tracker.state.keyframes[-1:]
        step = tracker.track(frame)
        if memory is None:
            continue
        starts = {start.count: start for start in (memory.keyframe, *newest)}
        for start in starts.values():
            belief = carried_to(memory, start).belief
            if not belief.is_ready:
                continue
            pair = FramePair(start.frame, frame, None)
            T_true = invert(film.T_world_cam[k]) @ film.T_world_cam[start.count]
            depth = sparse(np.asarray(start.frame.depth))
            case = Case(pair, T_true, depth, 0.0, maker)
            # where the tracker came to: what it expected is near, right or not
            T_near = invert(step.T_world_cam) @ start.T_world_cam
            answer = remembered_answer(case, T_near, belief)
            if answer is not None:
                yield case, answer


def remembered_answer(
    case: Case, T_near: np.ndarray, belief: Belief
) -> Answer | None:
    """The direct motion from one that is near; None where images and depth maps do not match."""
    rough = align_images(case.pair, T_near, belief=belief, is_near=True)
    direct = sure_alignment(rough, 0.0)
    if direct is None:
        return None
    evidence = direct.evidence
    if not isinstance(evidence, RememberedEvidence):
        evidence = (*evidence, NO_BELIEF)
    return Answer(DIRECT, evidence, case.error_px(direct.T_curr_prev))


def sparse(depth: np.ndarray) -> np.ndarray:
    """A depth map (H, W) of which every so many pixels are left."""
    every = max(1, int(np.sqrt(depth.size / POINTS)))
    kept = np.zeros_like(depth)
    kept[::every, ::every] = depth[::every, ::every]
    return kept


def answers(case: Case, models: Models) -> Iterator[Answer]:
    """The answers by cues, and by PWVO's scores."""
    yield from cue_answers(case)
    yield from chosen_answers(case, models)


def chosen_answers(case: Case, models: Models) -> Iterator[Answer]:
    """The answers by PWVO's scores after each source."""
    ctx = Context(models=models)
    evidence = ctx.evidence(case.pair)
    if search_of(evidence) is None:
        return
    # after each source: what is stated then must be right then
    for motion in by_flow(evidence, ctx):
        if motion.usable:
            yield Answer(CHOICE, motion.evidence, case.error_px(motion.T_curr_prev))


def cue_answers(case: Case) -> Iterator[Answer]:
    """The answer by cues, where there is something to choose."""
    ctx = Context()
    evidence = ctx.evidence(case.pair)
    if search_of(evidence) is None:
        return
    motion = run_method(evidence, "classical", ctx)
    if motion.usable:
        yield Answer(CUES, motion.evidence, case.error_px(motion.T_curr_prev))


def search_of(evidence: PairEvidence) -> Any:
    """The motions of the search, None where it failed."""
    try:
        return next(evidence.flows()).motions
    except StageFailed:
        return None


# --- fits -------------------------------------------------------------------------


def report(name: str, labelled: list[Labelled]) -> None:
    """Print the weights of one probability, and how well
    they separate right answers.
    """
    right = np.array([row.is_right for row in labelled])
    print(f"{name}: {len(right)} answers, {right.sum()} right")
    has_both = 0 < right.sum() < len(right)
    if not has_both:
        return
    evidence = np.array([row.evidence for row in labelled])
    makers = np.array([row.maker for row in labelled])
    weights = fit_of(name, evidence, right, makers)
    print(f"  {', '.join(digits_of(each) for each in weights)}")
    limit = DIRECT_PROBABILITY if name == DIRECT else MIN_PROBABILITY
    print(f"  all makers: {figures(stated(evidence, weights), right, limit)}")
    left_out = np.full(len(right), np.nan)
    for maker in sorted(set(makers)):
        mine = makers == maker
        if mine.all():
            continue
        others = fit_of(name, evidence[~mine], right[~mine], makers[~mine])
        left_out[mine] = stated(evidence[mine], others)
        print(f"  without {maker}: {figures(left_out[mine], right[mine], limit)}")
    if not np.isnan(left_out).any():
        print(f"  each left out: {figures(left_out, right, limit)}")


def fit_of(
    name: str, evidence: np.ndarray, right: np.ndarray, makers: np.ndarray
) -> tuple[np.ndarray, ...]:
    """The weights of one probability, or of the two of a direct motion."""
    counts = maker_weights(list(makers))
    if name == DIRECT:
        return fit_direct(evidence[:, :-1], evidence[:, -1], right, counts)
    ridge = CUES_RIGHT_RIDGE if name == CUES else RIDGE
    return (fit(evidence, right, counts, ridge),)


def stated(evidence: np.ndarray, weights: tuple[np.ndarray, ...]) -> np.ndarray:
    """(N,) probabilities by fitted weights, see :func:`fit_of`."""
    if len(weights) == 1:
        return logistic(evidence, weights[0])
    exact, of_scene = weights
    seen = evidence[:, :-1]
    is_of_scene = logistic(seen[:, -1:], of_scene)
    return logistic(seen, exact) * where_known(evidence[:, -1], is_of_scene)


def figures(probability: np.ndarray, right: np.ndarray, limit: float) -> str:
    """What is told of some answers (N,)."""
    is_sure = probability >= limit
    area = area_under_curve(probability, right)
    return (
        f"{len(right)} answers, {right.sum()} right, AUROC {area}, calibration error "
        f"{calibration_error(probability, right)}, {(right & ~is_sure).sum()} right ones below, "
        f"{(~right & is_sure).sum()} wrong ones above"
    )


def maker_weights(makers: list[str]) -> np.ndarray:
    """Weight (N,) of each answer, with which every maker counts alike; their mean is one."""
    names, index, counts = np.unique(
        makers, return_inverse=True, return_counts=True
    )
    return len(makers) / (len(names) * counts[index])


def fit(
    evidence: np.ndarray,
    right: np.ndarray,
    counts: np.ndarray | float = 1.0,
    ridge: float = RIDGE,
) -> np.ndarray:
    """Weights of a logistic regression on evidence (N, k).

    Args:
        evidence: (N, k).
        right: (N,) bool.
        counts: (N,) by how much each answer counts.
        ridge: see :data:`RIDGE`.

    Returns:
        (k + 1,) weights; the last one is the constant.
    """
    mean = evidence.mean(axis=0)
    std = evidence.std(axis=0)
    # evidence that never varies gets no slope
    std = np.where(std > 0, std, 1.0)
    unit = (evidence - mean) / std
    sign = np.where(right, 1.0, -1.0)

    def cost(w: np.ndarray) -> float:
        slopes = w[:-1]
        loss = counts * np.logaddexp(0, -sign * (unit @ slopes + w[-1]))
        return float(loss.mean() + ridge * slopes @ slopes / 2)

    start = np.zeros(evidence.shape[1] + 1)
    w = minimize(cost, start, method="BFGS").x
    slopes = w[:-1] / std
    return np.append(slopes, w[-1] - mean @ slopes)


def logistic(evidence: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N,) probabilities of evidence (N, k) under the weights (k + 1,) of a logistic function."""
    return np.asarray(expit(evidence @ weights[:-1] + weights[-1]))


def digits_of(weights: np.ndarray) -> str:
    """Weights as they are written into a calibration."""
    return f"({', '.join(f'{w:.2f}' for w in weights)})"


def fit_direct(
    evidence: np.ndarray,
    certainty: np.ndarray,
    right: np.ndarray,
    counts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the two probabilities whose product is that of a direct motion.

    Args:
        evidence: (N, k), see :class:`hybridvo.solver.aligned_points.DirectEvidence`.
        certainty: (N,) log odds of the belief that was asked, NO_BELIEF where none was.
        right: (N,) bool.
        counts: (N,) by how much each answer counts.

    Returns:
        (k + 1,) that it is exact, by all of the evidence, and (2,) that it is the scene's, by the
        last of it; the last number of each is the constant. Where a belief was asked, it says that
        the motion is the scene's.
    """
    mean = evidence.mean(axis=0)
    std = evidence.std(axis=0)
    unit = (evidence - mean) / std
    count = evidence.shape[1]

    def parts(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The two sets of weights, on evidence of unit variance."""
        return w[: count + 1], w[count + 1 :]

    def cost(w: np.ndarray) -> float:
        exact, of_scene = parts(w)
        is_of_scene = logistic(unit[:, -1:], of_scene)
        stated = logistic(unit, exact) * where_known(certainty, is_of_scene)
        p = np.clip(stated, TINY, 1 - TINY)
        loss = -counts * np.log(np.where(right, p, 1 - p))
        slopes = np.append(exact[:-1], of_scene[:-1])
        return float(loss.mean() + RIDGE * slopes @ slopes / 2)

    tries = []
    for slope, exact_constant, scene_constant in DIRECT_STARTS:
        start = [slope] * count + [exact_constant, slope, scene_constant]
        tries.append(minimize(cost, np.array(start), method="BFGS"))
    exact, of_scene = parts(min(tries, key=lambda each: each.fun).x)
    slopes = exact[:-1] / std
    scene_slope = of_scene[:-1] / std[-1:]
    return (
        np.append(slopes, exact[-1] - mean @ slopes),
        np.append(scene_slope, of_scene[-1] - mean[-1:] @ scene_slope),
    )


def where_known(certainty: np.ndarray, is_of_scene: np.ndarray) -> np.ndarray:
    """(N,) probabilities that motions are the scene's: of a belief (N,) where one was asked."""
    by_belief = expit(certainty + CERTAINTY_BONUS)
    return np.where(np.isnan(certainty), is_of_scene, by_belief)


class CueTable(NamedTuple):
    """The cues of the motions of a pair, and which motions are right."""

    values: np.ndarray  # (N, k)
    right: np.ndarray  # (N,) bool
    names: list[str]


def cue_weights(args: argparse.Namespace) -> dict[str, float]:
    """Weights with which the right motions of a pair are the
    likeliest, where some are wrong.
    """
    cases = chain(development_cases(args), heavy_cases("true"), scenario_cases())
    tables = [table for case in cases if (table := cue_table(case)) is not None]
    every = np.concatenate([table.values for table in tables])
    std = every.std(axis=0)

    def cost(w: np.ndarray) -> float:
        losses = []
        for table in tables:
            score = table.values / std @ w
            losses.append(logsumexp(score) - logsumexp(score[table.right]))
        return float(np.mean(losses) + CUE_RIDGE * w @ w / 2)

    names = tables[-1].names
    fitted = minimize(cost, np.zeros(len(names)), method="BFGS").x / std
    print(f"cues: {len(tables)} pairs with right and wrong motions")
    return {name: round(float(w), 2) for name, w in zip(names, fitted, strict=True)}


def cue_table(case: Case) -> CueTable | None:
    """The cues of a pair.

    None where its motions are all right or all wrong, or one is clear.
    """
    searched_motions = search_of(Context().evidence(case.pair))
    if searched_motions is None:
        return None
    motions = to_hypotheses(searched_motions, cue_candidates(searched_motions))
    errors = np.array([case.error_px(motion.T_curr_prev) for motion in motions])
    right = errors <= allowed_error_px(case.oracle_px)
    if right.all() or not right.any():
        return None
    values = compute_cues(searched_motions.grid, motions)
    return CueTable(np.stack(values, axis=1), right, list(Cues._fields))


if __name__ == "__main__":
    sys.exit(main())
