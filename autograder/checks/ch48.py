"""Checks of chapter 48: cases, named misconceptions and correct variants for the statistics of comparisons, races and the bug lab."""

from __future__ import annotations

import bisect
import itertools
import math

import numpy as np
import torch

from autograder.authoring.parts import (
    after,
    altered,
    bad_input_accepted,
    drawing,
    drawn_once,
    dtype_lost,
    in_place,
    integers,
    misshapen,
    normal,
    number,
    one_shape,
    python_float,
    replaced,
    rows_cut,
    satisfies,
    shape_cases,
    spoilt,
    uniform,
    versions_of,
    without,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib.checks.cases import built
from course_lib.control.replay import Transitions
from solutions import ch48

# ------------------------------------------------------------------------------------------------------ interquartile_mean


@drawing
def _scores(generator, *shape, outlier=0.0):
    scores = 100 + 30 * normal(generator, *shape)
    scores.view(-1)[int(uniform(generator, 1) * scores.numel())] += outlier
    return {"scores": scores}


@drawing
def _tasks_apart(generator, seeds=5, tasks=3):
    """Tasks on different levels: the middle half of all is not the mean of middle halves."""
    levels = torch.tensor([0.0, 40.0, 400.0], dtype=torch.float64)[:tasks]
    return {"scores": levels + 10 * normal(generator, seeds, tasks)}


def _four_of_each(scores):
    """Every score four times: then a quarter of the entries is a whole number."""
    return torch.tensor(_middle_half(np.sort(np.repeat(scores.numpy().ravel(), 4))), dtype=scores.dtype)


def _middle_half(ordered):
    quarter = len(ordered) // 4
    return ordered[quarter : 3 * quarter].mean(0)


def _cut_by_weight(x, low, high=None):
    """The mean of what is left when shares of the weight are cut off at both ends."""
    count = len(x)
    edges = torch.arange(count + 1, dtype=x.dtype).clamp(low * count, (1 - (low if high is None else high)) * count)
    return edges.diff() @ x / edges.diff().sum()


def _by_task(scores):
    return torch.stack([ch48.interquartile_mean(column) for column in scores.reshape(len(scores), -1).unbind(1)])


def _in_numpy_by_area(scores):
    """The area between the quartiles under the quantile function."""
    areas = np.concatenate([[0.0], np.cumsum(np.sort(scores.numpy().ravel()))]) / scores.numel()
    ends = np.interp([0.25, 0.75], np.linspace(0, 1, scores.numel() + 1), areas)
    return torch.tensor(2 * (ends[1] - ends[0]), dtype=scores.dtype)


def _sorted(formula):
    return lambda scores: formula(scores.flatten().sort().values)


def _trimmed(cut):
    """The mean after whole entries were cut; `cut` says how many of n at each end."""
    return _sorted(lambda x: x[cut(len(x)) : max(len(x) - cut(len(x)), cut(len(x)) + 1)].mean())


def _between_quartiles(x):
    low, high = x.quantile(0.25), x.quantile(0.75)
    return x[(x >= low) & (x <= high)].mean()


def _quantile_integral(x):
    """The integral of the step function between 1/4 and 3/4."""
    count = len(x)
    overlaps = [min((i + 1) / count, 0.75) - max(i / count, 0.25) for i in range(count)]
    return 2 * sum(max(overlap, 0.0) * x[i] for i, overlap in enumerate(overlaps))


def _edges_in_part(x):
    count = len(x)
    whole, part = divmod(count, 4)
    inner = x[whole : count - whole].clone()
    weights = torch.ones_like(inner)
    if len(inner) == 1:
        return inner[0]
    weights[0] = weights[-1] = 1 - part / 4
    return (weights * inner).sum() / weights.sum()


_WRONG_INTERQUARTILE_MEAN = {
    "mean": (_sorted(torch.mean), "This is the mean of all scores: one lucky run moves it."),
    "median": (
        _sorted(lambda x: x.quantile(0.5)),
        "This is the median, which looks at one or two scores: the interquartile mean uses the middle half.",
    ),
    "whole-entries-rounded-down": (
        _trimmed(lambda n: n // 4),
        "Too little is cut where the count is no multiple of 4: the scores at the edges count in part, so that the weights sum"
        " to half of the count.",
    ),
    "whole-entries-rounded-up": (
        _trimmed(lambda n: -(-n // 4)),
        "Too much is cut where the count is no multiple of 4: the scores at the edges count in part, so that the weights sum to"
        " half of the count.",
    ),
    "a-quarter-in-all": (
        _sorted(lambda x: _cut_by_weight(x, 0.125)),
        "A quarter is cut off in all: it is a quarter at each end, which leaves half.",
    ),
    "upper-half": (
        _sorted(lambda x: _cut_by_weight(x, 0.5, 0.0)),
        "Both quarters are cut off at the lower end: the best runs are kept, and they are the lucky ones.",
    ),
    "mid-of-the-quartiles": (
        _sorted(lambda x: 0.5 * (x.quantile(0.25) + x.quantile(0.75))),
        "This is the middle between the two quartiles: the interquartile mean averages the scores between them.",
    ),
    "between-interpolated-quartiles": (
        _sorted(_between_quartiles),
        "The scores between torch.quantile's quartiles are no half of the weight: sort, and cut n / 4 at each end, the edges in part.",
    ),
    "not-sorted": (
        lambda scores: _cut_by_weight(scores.flatten(), 0.25),
        "The scores are cut in the order in which they came: sort them first.",
    ),
    "task-by-task": (
        lambda scores: _by_task(scores).mean(),
        "All entries are taken together: here each task is trimmed for itself, and a task without a middle counts as much.",
    ),
    "one-number-for-each-task": (
        lambda scores: _by_task(scores).squeeze(),
        "One number is asked for: flatten the scores before sorting.",
    ),
}

INTERQUARTILE_MEAN = Exercise(
    name="interquartile_mean",
    reference=ch48.interquartile_mean,
    criteria={"values": 0.85, "dtype": 0.1, "inputs": 0.05},
    cases=drawn_once(
        Case("eight seeds", _scores(8), closed_form=_four_of_each, visible=True, draws=2),
        Case("five seeds", _scores(5), closed_form=_four_of_each, visible=True, draws=2),
        Case("ten seeds, one of them lucky", _scores(10, outlier=5000.0), closed_form=_four_of_each, visible=True),
        Case("seven seeds, one of them failed", _scores(7, outlier=-5000.0), closed_form=_four_of_each),
        Case("six seeds", _scores(6), closed_form=_four_of_each),
        Case("five seeds of three tasks", _tasks_apart(), closed_form=_four_of_each, visible=True, draws=2),
        Case("four seeds of two tasks", _tasks_apart(4, 2), closed_form=_four_of_each),
        Case("a single seed", _scores(1), closed_form=_four_of_each, visible=True),
        Case("two seeds", _scores(2), closed_form=_four_of_each),
        Case("single precision", _scores(9), dtype=torch.float32, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_INTERQUARTILE_MEAN),
        *spoilt(ch48.interquartile_mean, python_float, dtype_lost, changed="scores"),
    ),
    variants={
        "four of each": lambda scores: _middle_half(scores.flatten().repeat_interleave(4).sort().values),
        "integral of the quantile function": _sorted(_quantile_integral),
        "edges in part": _sorted(_edges_in_part),
        "NumPy": _in_numpy_by_area,
        "topk": lambda scores: _edges_in_part(scores.flatten().topk(scores.numel(), largest=False).values),
    },
)


# ------------------------------------------------------------------------------------------------------ bootstrap_interval

HALVES = (0, 0, 0, 0, 1, 1, 1, 1)
FEW = (0, 0, 1, 1)
LUCKY = (0, 0, 0, 1)


@drawing
def _pattern(generator, *columns, confidence=0.5, num_resamples=400):
    """Few distinct scores, in random order and units. Their resampled means are few, too, and the ends of the interval fall on
    them: then every right bootstrap gives the same numbers but for one draw in millions."""
    rows = torch.tensor(columns, dtype=torch.float64).T
    rows = torch.stack([column[torch.randperm(len(column), generator=generator)] for column in rows.T], 1)
    scale, shift = 1 + 9 * uniform(generator, 1), 100 * normal(generator, 1)
    scores = shift + scale * rows
    return {
        "scores": scores[:, 0] if len(columns) == 1 else scores,
        "confidence": confidence,
        "num_resamples": num_resamples,
        "generator": built("seeding.generator", seed=int(1e6 * uniform(generator, 1))),
    }


def _together(generator):
    """Two tasks in which the same seeds do well in one and badly in the other."""
    drawn = _pattern(FEW)(generator)
    first = drawn["scores"]
    return drawn | {"scores": torch.stack([first, first.max() + first.min() - first], 1)}


def _ends(name, inputs, **options):
    """A case in which the interval's ends are looked at."""
    return Case(name, inputs, rtol=1e-4, atol=1e-4, **options)


def _certain(scores, **_rest):
    return (ch48.interquartile_mean(scores),) * 2


def _trimmed_rows(rows):
    """The interquartile mean of every row at once."""
    count = rows.shape[1]
    edges = torch.arange(count + 1, dtype=rows.dtype).clamp(count / 4, 3 * count / 4)
    return rows.sort(1).values @ edges.diff() / (count / 2)


def _picked(by_task, count, generator, size=None):
    """`count` resamples of `size` seeds (as many as there are) for each task apart: (count, size, tasks)."""
    shape = (count, size or len(by_task), by_task.shape[1])
    picks = torch.randint(len(by_task), shape, generator=generator)
    return by_task.gather(0, picks.flatten(0, 1)).view(shape)


def _stratified(*given):
    return _picked(*given).flatten(1)


def _quantiles(means, confidence):
    return means.quantile((1 - confidence) / 2), means.quantile((1 + confidence) / 2)


def _bootstrap(statistic=_trimmed_rows, draw=_stratified, ends=_quantiles, size=lambda num_resamples: num_resamples):
    """A version: `draw(by_task, count, generator)` gives resampled scores, (count, entries); `ends` makes two of their `statistic`."""

    def version(scores, confidence=0.95, num_resamples=2000, generator=None):
        resampled = draw(scores.reshape(len(scores), -1), size(num_resamples), generator)
        return ends(statistic(resampled), confidence)

    return version


def _and_centre(finish):
    """A version: `finish` makes the interval of the scores' own interquartile mean and of the resampled ones."""

    def version(scores, confidence=0.95, num_resamples=2000, generator=None):
        centre = ch48.interquartile_mean(scores)
        return _bootstrap(ends=lambda means, _: finish(centre, means, confidence))(scores, confidence, num_resamples, generator)

    return version


def _by_multinomial(by_task, count, generator):
    """Seeds as the outcomes of a multinomial with equal weights."""
    size = len(by_task)
    weights = torch.ones(count, size)
    picks = [torch.multinomial(weights, size, replacement=True, generator=generator) for _ in by_task.T]
    return torch.cat([column[rows] for column, rows in zip(by_task.T, picks, strict=True)], 1)


def _by_floor(by_task, count, generator):
    """Seeds by rounding down uniform numbers."""
    size, tasks = by_task.shape
    picks = (torch.rand((count, size, tasks), generator=generator, dtype=torch.float64) * size).long()
    return torch.cat([by_task[picks[:, :, task], task] for task in range(tasks)], 1)


def _by_numpy(by_task, count, generator):
    """NumPy's generator, seeded from torch's."""
    chance = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
    picks = chance.integers(len(by_task), size=(count, *by_task.shape))
    return torch.from_numpy(np.take_along_axis(by_task.numpy()[None], picks, axis=1).reshape(count, -1))


def _percentiles(means, confidence):
    ends = np.percentile(means.numpy(), [50 * (1 - confidence), 50 * (1 + confidence)])
    return tuple(torch.from_numpy(ends).to(means.dtype))


def _task_by_task(scores, confidence=0.95, num_resamples=2000, generator=None):
    """Each score four times over, so that a quarter can be cut off; the interval's ends by counting."""
    by_task = scores.reshape(len(scores), -1)
    drawn = [column[torch.randint(len(column), (num_resamples, len(column)), generator=generator)] for column in by_task.T]
    means = _middle_half(torch.cat(drawn, 1).repeat_interleave(4, 1).sort(1).values.T).sort().values
    tail = (1 - confidence) / 2
    return means[int(tail * num_resamples)], means[int((1 - tail) * num_resamples) - 1]


_WRONG_BOOTSTRAP_INTERVAL = {
    "mean-instead-of-the-interquartile-mean": (
        _bootstrap(lambda rows: rows.mean(1)),
        "This is an interval for the mean: bootstrap the interquartile mean.",
    ),
    "median-instead-of-the-interquartile-mean": (
        _bootstrap(lambda rows: rows.quantile(0.5, dim=1)),
        "This is an interval for the median: bootstrap the interquartile mean.",
    ),
    "tasks-mixed": (
        _bootstrap(draw=lambda x, count, g: x.flatten()[torch.randint(x.numel(), (count, x.numel()), generator=g)]),
        "Scores are drawn from all tasks together, so that a resample may hold one task twice as often as another, and the"
        " interval is too wide: draw seeds within each task.",
    ),
    "whole-rows": (
        _bootstrap(draw=lambda x, count, g: x[torch.randint(len(x), (count, len(x)), generator=g)].flatten(1)),
        "The same seeds are drawn for all tasks, as if seed 3 of one task had anything to do with seed 3 of another: draw for each"
        " task apart.",
    ),
    "without-replacement": (
        _bootstrap(draw=lambda x, count, g: 0 * _stratified(x, count, g) + x.flatten()),
        "Every seed is drawn once, so that all resamples are the same and the interval has no width: draw with replacement.",
    ),
    "half-as-many": (
        _bootstrap(draw=lambda x, count, g: _stratified(x, count, g, max(len(x) // 2, 1))),
        "A resample has as many seeds as there are: with fewer the interval is too wide.",
    ),
    "tasks-averaged": (
        _bootstrap(lambda rows: torch.stack([_trimmed_rows(task) for task in rows.unbind(2)]).mean(0), draw=_picked),
        "Each task's interquartile mean is taken for itself: it is one mean over all entries of the resample.",
    ),
    "tails-not-halved": (
        _bootstrap(ends=lambda means, confidence: (means.quantile(1 - confidence), means.quantile(confidence))),
        "1 - confidence is left out at each end: it is half of that, as there are two ends.",
    ),
    "one-sided": (
        _bootstrap(ends=lambda means, confidence: (means.min(), means.quantile(confidence))),
        "All that is left out is left out at the upper end: leave out (1 - confidence) / 2 at either end.",
    ),
    "extremes": (
        _bootstrap(ends=lambda means, _: (means.min(), means.max())),
        "The smallest and the largest resampled mean are returned, which move apart with the number of resamples: take the quantiles.",
    ),
    "normal-approximation": (
        _and_centre(lambda centre, means, _: (centre - 1.96 * means.std(), centre + 1.96 * means.std())),
        "Centre ± 1.96 standard deviations is symmetric and ignores `confidence`: a percentile interval takes quantiles of the"
        " resampled means.",
    ),
    "mirrored": (
        _and_centre(lambda centre, means, confidence: _quantiles(2 * centre - means, confidence)),
        "This is the basic bootstrap, which mirrors the interval at the centre: the percentile interval takes the quantiles as they are.",
    ),
    "ends-swapped": (_bootstrap(ends=lambda *given: _quantiles(*given)[::-1]), "The lower end comes first."),
    "num-resamples-ignored": (_bootstrap(size=lambda _: 2000), "The number of resamples is fixed: draw num_resamples of them."),
    "own-generator": (
        _bootstrap(draw=lambda x, count, _: _stratified(x, count, None)),
        "Nothing is drawn from `generator`, so the interval is another one each time: hand it on to whatever draws.",
    ),
    "python-floats": (
        after(ch48.bootstrap_interval, lambda interval: tuple(end.item() for end in interval)),
        "Return 0-dim tensors, not Python floats.",
    ),
    "dtype-lost": (
        after(ch48.bootstrap_interval, lambda interval: tuple(end.float() for end in interval)),
        "The results have lost the scores' dtype.",
    ),
}

BOOTSTRAP_INTERVAL = Exercise(
    name="bootstrap_interval",
    reference=ch48.bootstrap_interval,
    criteria={"values": 1.3, "dtype": 0.1, "inputs": 0.1},
    cases=drawn_once(
        _ends("eight seeds, half of them failed", _pattern(HALVES), visible=True),
        _ends("four seeds, one of them lucky", _pattern(LUCKY, confidence=0.7), visible=True),
        _ends("confidence 0.9", _pattern(HALVES, confidence=0.9, num_resamples=1000)),
        _ends("two tasks", _pattern(FEW, [score + 10 for score in FEW], confidence=0.7), visible=True),
        _ends("two tasks in which seeds trade places", _together, visible=True, draws=2),
        _ends(
            "three tasks, all seeds alike: no width", _pattern(*((x,) * 6 for x in (0, 1, 5))), closed_form=_certain, visible=True
        ),
        _ends("a single seed: no width", _pattern((3,)), closed_form=_certain),
        _ends("default settings", without(_pattern(HALVES), "confidence", "num_resamples"), visible=True),
        _ends("no generator", replaced(_pattern(HALVES), generator=None)),
        _ends("a single resample: no width", _pattern(HALVES, num_resamples=1), view="width", visible=True),
        Case("what is drawn from", _pattern(HALVES, num_resamples=20), returns=("generator",), view="drawn_from", visible=True),
        _ends("single precision", _pattern(HALVES), dtype=torch.float32, visible=True),
    ),
    misconceptions=(*wrong(_WRONG_BOOTSTRAP_INTERVAL), in_place(ch48.bootstrap_interval, "scores")),
    variants={
        "all resamples at once": _bootstrap(),
        "rounded uniform numbers": _bootstrap(draw=_by_floor),
        "task by task": _task_by_task,
        "multinomial": _bootstrap(draw=_by_multinomial),
        "NumPy, seeded from the generator": _bootstrap(draw=_by_numpy, ends=_percentiles),
    },
)

# ----------------------------------------------------------------------------------------------------- steps_to_threshold

THRESHOLD = 100.0
RUNS = {
    "climbs": (10.0, 40.0, 80.0, 130.0, 160.0, 190.0),
    "dips before": (20.0, 70.0, 30.0, 120.0, 150.0, 180.0),
    "wanders": (15.0, 90.0, 140.0, 60.0, 70.0, 150.0),
    "loses it": (5.0, 50.0, 180.0, 200.0, 90.0, 20.0),
    "late": (0.0, 5.0, 10.0, 20.0, 60.0, 110.0),
    "begins above": (120.0, 60.0, 40.0, 105.0, 125.0, 150.0),
    "never": (5.0, 20.0, 45.0, 70.0, 92.0, 85.0),
    "touches": (30.0, 60.0, 100.0, 80.0, 40.0, 50.0),
}
"""Curves by what they do at the threshold."""


@drawing
def _curves(generator, *kinds, unit=1000.0):
    """One run of each kind. Returns have a scale and a shift of their own, and each is drawn anew on its side of the threshold; one
    that equals the threshold still does."""
    shape = torch.tensor([RUNS[kind] for kind in kinds], dtype=torch.float64) - THRESHOLD
    scale, shift = (1 + 4 * uniform(generator, 1)).item(), (50 * normal(generator, 1)).item()
    stretched = shape * (0.9 + 0.2 * uniform(generator, *shape.shape))
    gaps = unit * (0.5 + uniform(generator, shape.shape[1]))
    # on a grid of powers of two, threshold + returns - threshold is exact: a curve that touches touches
    threshold = round(shift * 64) / 64
    return {"steps": gaps.cumsum(0), "returns": threshold + (scale * stretched * 64).round() / 64, "threshold": threshold}


def _cut(given, count):
    """The first evaluations alone."""
    return {"steps": given["steps"][:count], "returns": given["returns"][:, :count]}


def _stuck(given):
    """Two evaluations at one step."""
    steps = given["steps"].clone()
    steps[3] = steps[2]
    return {"steps": steps}


_timed = versions_of(
    ch48.steps_to_threshold,
    satisfies(lambda returns, steps: returns.dim() == 2 and steps.dim() == 1 and returns.shape[1] == len(steps)),
    satisfies(lambda steps: bool((steps[1:] > steps[:-1]).all())),
)


def _each(of_run, checked=True):
    """A version, run by run: `of_run(s, r, threshold)` takes lists."""

    def version(steps, returns, threshold):
        found = [of_run(steps.tolist(), run, float(threshold)) for run in returns.tolist()]
        return torch.tensor(found, dtype=returns.dtype)

    return _timed(version, checked)


def _first(r, threshold):
    """The place of the first evaluation at the threshold or above, None if there is none."""
    return next((k for k, value in enumerate(r) if value >= threshold), None)


def _between(s, r, k, threshold):
    """Where the line from evaluation k - 1 to k is at the threshold."""
    return s[k - 1] + (threshold - r[k - 1]) / (r[k] - r[k - 1]) * (s[k] - s[k - 1])


def _crossing(k, s, r, threshold, never=math.inf):
    return never if k is None else s[0] if k == 0 else _between(s, r, k, threshold)


def _right(s, r, threshold, **given):
    return _crossing(_first(r, threshold), s, r, threshold, **given)


def _at_evaluation(s, r, threshold):
    k = _first(r, threshold)
    return math.inf if k is None else s[k]


def _before_it(s, r, threshold):
    k = _first(r, threshold)
    return math.inf if k is None else s[max(k - 1, 0)]


def _for_good(s, r, threshold):
    """From where on it stays at the threshold or above."""
    below = [k for k, value in enumerate(r) if value < threshold]
    k = below[-1] + 1 if below else 0
    return _crossing(k if k < len(r) else None, s, r, threshold)


def _last_crossing(s, r, threshold):
    crossings = [k for k in range(1, len(r)) if r[k - 1] < threshold <= r[k]]
    return _crossing(crossings[-1], s, r, threshold) if crossings else _right(s, r, threshold)


def _above_only(s, r, threshold):
    return _crossing(next((k for k, value in enumerate(r) if value > threshold), None), s, r, threshold)


def _at_the_best(s, r, threshold):
    return s[r.index(max(r))] if max(r) >= threshold else math.inf


def _nearest(s, r, threshold):
    return min(zip(r, s, strict=True), key=lambda pair: abs(pair[0] - threshold))[1] if max(r) >= threshold else math.inf


def _by_running_best(s, r, threshold):
    return _right(s, list(itertools.accumulate(r, max)), threshold)


def _wrapped(s, r, threshold):
    """An index of -1 at the first evaluation."""
    k = _first(r, threshold)
    return math.inf if k is None else _between(s, r, k, threshold)


def _from_nothing(s, r, threshold):
    """Every curve begins with a return of 0 at no steps."""
    k = _first(r, threshold)
    return math.inf if k is None else _between([0.0, *s], [0.0, *r], k + 1, threshold) if r[k] else s[k]


def _other_share(s, r, threshold):
    k = _first(r, threshold)
    return math.inf if k is None else s[0] if k == 0 else s[k - 1] + s[k] - _between(s, r, k, threshold)


def _in_the_middle(s, r, threshold):
    k = _first(r, threshold)
    return math.inf if k is None else s[0] if k == 0 else 0.5 * (s[k - 1] + s[k])


def _as_weights(s, r, threshold):
    k = _first(r, threshold)
    if not k:
        return math.inf if k is None else s[0]
    after, before = r[k] - threshold, threshold - r[k - 1]
    return (after * s[k - 1] + before * s[k]) / (after + before)


def _of_the_mean_curve(steps, returns, threshold):
    mean = returns.mean(0)
    return torch.full((len(returns),), _right(steps.tolist(), mean.tolist(), float(threshold)), dtype=returns.dtype)


def _all_segments(steps, returns, threshold):
    """A variant: every segment that crosses upwards, and the earliest of them."""
    low, high = returns[:, :-1], returns[:, 1:]
    at = steps[:-1] + (threshold - low) / (high - low) * steps.diff()
    crossing = torch.where((low < threshold) & (high >= threshold), at, math.inf)
    begun = torch.where(returns[:, :1] >= threshold, steps[:1], math.inf)
    return torch.cat([begun, crossing], 1).amin(1).to(returns.dtype)


def _by_counting(steps, returns, threshold):
    """A variant: evaluations before the first that reaches are counted."""
    before = ((returns >= threshold).cumsum(1) == 0).sum(1)
    found = []
    for run, k in zip(returns, before.tolist(), strict=True):
        if 0 < k < len(steps):
            found.append(torch.lerp(steps[k - 1], steps[k], ((threshold - run[k - 1]) / (run[k] - run[k - 1])).to(steps.dtype)))
        else:
            found.append(steps[0] if k == 0 else torch.tensor(math.inf))
    return torch.stack([one.to(returns.dtype) for one in found])


_WRONG_STEPS_TO_THRESHOLD = {
    "first-evaluation-above": (
        _at_evaluation,
        "This is the evaluation by which the threshold is reached, which depends on how often one evaluates: interpolate between it and"
        " the one before.",
    ),
    "last-evaluation-below": (
        _before_it,
        "This is the last evaluation before the threshold is reached: interpolate between it and the next.",
    ),
    "half-way": (
        _in_the_middle,
        "The middle between two evaluations is taken: the curve is at the threshold nearer to the one whose return is nearer.",
    ),
    "share-of-the-other-side": (
        _other_share,
        "The share counts from the evaluation before: (threshold - before) / (after - before).",
    ),
    "never-is-the-last-step": (
        lambda *given: _right(*given, never=given[0][-1]),
        "A run that never reaches the threshold counts as if it had done so at its last step. It is censored: infinity, so that no"
        " statistic takes it for a success.",
    ),
    "never-is-the-first-step": (
        lambda *given: _right(*given, never=given[0][0]),
        "A run that never reaches the threshold gets the first step: argmax of a row of False is 0. Ask `any` as well, and return"
        " infinity.",
    ),
    "never-is-nan": (
        lambda *given: _right(*given, never=math.nan),
        "A run that never reaches the threshold is not unknown: it is later than all others. Infinity can be sorted, nan cannot.",
    ),
    "never-is-minus-one": (
        lambda *given: _right(*given, never=-1.0),
        "A run that never reaches the threshold is the slowest of all, and -1 makes it the fastest: return infinity.",
    ),
    "for-good": (
        _for_good,
        "This is where the curve stays above from then on. Asked for is where it *first* reaches the threshold, lost again or not.",
    ),
    "last-crossing": (
        _last_crossing,
        "Of several crossings this is the last one. Asked for is where the curve *first* reaches the threshold: a run may dip again.",
    ),
    "strictly-above": (_above_only, "A return that equals the threshold reaches it: ≥, not >."),
    "at-the-best": (_at_the_best, "This is where the run was best, not where it first was good enough."),
    "nearest-return": (
        _nearest,
        "This is where the return is nearest to the threshold, before or after it was reached: take the first that is no less.",
    ),
    "running-best": (
        _by_running_best,
        "The line is drawn from the best return so far. It goes from the evaluation before, which may be lower.",
    ),
    "before-the-first-wraps": (
        _wrapped,
        "At the first evaluation there is none before it, and index -1 is the last one: a run that begins above has reached the"
        " threshold there.",
    ),
    "begins-at-nothing": (
        _from_nothing,
        "A curve is continued to a return of 0 at 0 steps, which nobody evaluated: a run that begins above has reached the threshold at"
        " its first evaluation.",
    ),
}

STEPS_TO_THRESHOLD = Exercise(
    name="steps_to_threshold",
    reference=ch48.steps_to_threshold,
    criteria={"values": 1.6, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    axes=("run",),
    cases=drawn_once(
        Case("a run that climbs", _curves("climbs"), visible=True, draws=2),
        Case("runs that dip and wander", _curves("dips before", "wanders", "late"), visible=True, draws=2),
        Case("one that loses it again", _curves("loses it", "climbs"), visible=True),
        Case("one that never does", _curves("climbs", "never", "late"), visible=True),
        Case("none ever does", _curves("never", "never"), closed_form=number(math.inf, math.inf)),
        Case("one that begins above", _curves("begins above", "wanders"), visible=True),
        Case("one that touches", _curves("touches", "never"), visible=True, draws=2),
        Case("all kinds, in seconds", _curves(*RUNS, unit=7.0), draws=2),
        Case("as many runs as evaluations", _curves("climbs", "late", "wanders", "never", "loses it", "touches")),
        Case("a single evaluation", altered(_curves("begins above", "never"), lambda x: _cut(x, 1)), visible=True),
        Case("single precision", _curves("climbs", "never", "late"), dtype=torch.float32, visible=True),
        Case("steps do not increase", altered(_curves("climbs", "late"), _stuck), raises=["steps"], visible=True, draws=1),
        misshapen(
            "returns without their first evaluation",
            _curves("climbs"),
            "returns",
            lambda r: r[:, 1:],
            ["returns", "steps"],
            draws=1,
        ),
        misshapen(
            "returns of one run, (T,)", _curves("climbs"), "returns", lambda r: r[0], ["returns", "steps"], visible=True, draws=1
        ),
    ),
    misconceptions=(
        *wrong(_WRONG_STEPS_TO_THRESHOLD, _each),
        Misconception(
            "of-the-mean-curve",
            _timed(_of_the_mean_curve),
            "All runs get the time at which their mean reaches the threshold: each run has a time of its own.",
        ),
        *spoilt(ch48.steps_to_threshold, dtype_lost, changed="returns"),
        bad_input_accepted(_each(_right, checked=False)),
    ),
    variants={
        "run by run": _each(_right),
        "all segments, the earliest": _timed(_all_segments),
        "evaluations counted": _timed(_by_counting),
        "as a weighted mean": _each(_as_weights),
    },
)

# ----------------------------------------------------------------------------------------------------------- race_counts

NEVER = None


@drawing
def _races(generator, ours, theirs, unit=1000.0):
    """Runs by the places of crossing and end, (place or NEVER, place), among moments that are drawn anew: who is before whom stays as it
    is, and a tie is one to the last bit."""
    moments = (unit * 64 * (0.1 + uniform(generator, 20)).cumsum(0)).round() / 64

    def when(places):
        return torch.tensor([math.inf if place is NEVER else moments[place].item() for place in places], dtype=torch.float64)

    columns = [when(places) for side in (ours, theirs) for places in zip(*side, strict=True)]
    return dict(zip(("ours", "our_ends", "theirs", "their_ends"), columns, strict=True))


@drawing
def _any_races(generator, n=5, m=7, places=12):
    """Races of all kinds; a third of the runs is censored, and among so few moments some tie."""

    def side(size):
        ends = integers(generator, 2, places, size)
        crossings = (uniform(generator, size) * (ends + 1)).long()
        censored = uniform(generator, size) < 0.35
        return [
            (NEVER if gone else at, end)
            for at, end, gone in zip(crossings.tolist(), ends.tolist(), censored.tolist(), strict=True)
        ]

    return _races(side(n), side(m))(generator)


_SHAPES = (one_shape("ours", "our_ends"), one_shape("theirs", "their_ends"))
_only_shapes = versions_of(ch48.race_counts, *_SHAPES)
_races_of = versions_of(
    ch48.race_counts,
    *_SHAPES,
    satisfies(lambda ours, our_ends: bool(((ours <= our_ends) | ours.isinf()).all())),
    satisfies(lambda theirs, their_ends: bool(((theirs <= their_ends) | theirs.isinf()).all())),
)


def _counts(*numbers):
    return tuple(torch.tensor(count) for count in numbers)


def _pair_by_pair(verdict, pairs=itertools.product):
    """A version: `verdict(a, u, b, v)` is 1 where ours won, -1 where theirs did, 0 where nobody knows, and None for what is not counted."""

    def version(*given):
        ours, our_ends, theirs, their_ends = (column.tolist() for column in given)
        runs = pairs(zip(ours, our_ends, strict=True), zip(theirs, their_ends, strict=True))
        found = [verdict(*one, *other) for one, other in runs]
        return _counts(*(found.count(result) for result in (1, -1, 0)))

    return _races_of(version)


def _all_pairs(ours, our_ends, theirs, their_ends):
    one, its_end = ours[:, None], our_ends[:, None]
    won = ((one < theirs) & (one <= their_ends)).sum()
    lost = ((theirs < one) & (theirs <= its_end)).sum()
    return won, lost, len(ours) * len(theirs) - won - lost


def _all_after(change):
    """A version that would be right, had `change` not been made to the four columns."""
    return _races_of(lambda *given: _all_pairs(*change(*given)))


def _cut_to(last, ours, our_ends, theirs, their_ends):
    """Nothing that came later than `last` was seen."""
    cut = (torch.where(crossed <= last, crossed, math.inf) for crossed in (ours, theirs))
    return next(cut), our_ends.clamp(max=last), next(cut), their_ends.clamp(max=last)


def _earlier(a, b):
    return (a < b) - (b < a)


def _by_cases(a, u, b, v):
    """What is right, case by case."""
    if a < math.inf and b < math.inf:
        return _earlier(a, b)
    if a < math.inf:
        return int(v >= a)
    if b < math.inf:
        return -int(u >= b)
    return 0


def _unless(condition, otherwise):
    """What is right, but for pairs of which `condition(a, u, b, v)` is true."""
    return lambda *pair: otherwise(*pair) if condition(*pair) else _by_cases(*pair)


def _in_the_common_window(ours, our_ends, theirs, their_ends):
    """A variant: a race lasts as long as both are watched; who has not crossed by then has not crossed."""
    last = torch.minimum(our_ends[:, None], their_ends[None])
    one = torch.where(ours[:, None] <= last, ours[:, None], math.inf)
    other = torch.where(theirs[None] <= last, theirs[None], math.inf)
    signs = (other - one).nan_to_num(0).sign()  # infinity minus infinity: neither
    return (signs > 0).sum(), (signs < 0).sum(), (signs == 0).sum()


def _from_sorted(ours, our_ends, theirs, their_ends):
    """A variant: of sorted lists, how many of them lie behind each crossing."""

    def beaten(crossed, others, ends):
        arrived = sorted(at for at in others.tolist() if at < math.inf)
        stopped = sorted(end for at, end in zip(others.tolist(), ends.tolist(), strict=True) if at == math.inf)
        mine = [at for at in crossed.tolist() if at < math.inf]
        return sum(
            len(arrived) - bisect.bisect_right(arrived, at) + len(stopped) - bisect.bisect_left(stopped, at) for at in mine
        )

    won, lost = beaten(ours, theirs, their_ends), beaten(theirs, ours, our_ends)
    return _counts(won, lost, len(ours) * len(theirs) - won - lost)


def _in_numpy(*given):
    """A variant: a censored run's end stands for its crossing, and what crosses no later than that, ties apart, has won."""
    ours, our_ends, theirs, their_ends = (column.numpy() for column in given)
    tied = np.equal.outer(ours, theirs)
    won = np.less_equal.outer(ours, np.where(np.isinf(theirs), their_ends, theirs)) & ~tied
    lost = np.greater_equal.outer(np.where(np.isinf(ours), our_ends, ours), theirs) & ~tied
    return tuple(torch.tensor(int(table.sum())) for table in (won, lost, ~(won | lost)))


def _gehan_scores(ours, our_ends, theirs, their_ends):
    """A variant: Gehan's score of each pair, summed by its sign."""
    known = ours.isfinite()[:, None], theirs.isfinite()
    later = (ours[:, None] < theirs) & known[1] | (ours[:, None] <= their_ends) & ~known[1]
    earlier = (theirs < ours[:, None]) & known[0] | (theirs <= our_ends[:, None]) & ~known[0]
    score = later.long() - earlier.long()
    return (score == 1).sum(), (score == -1).sum(), (score == 0).sum()


def _both_censored(a, _u, b, _v):
    return math.isinf(a) and math.isinf(b)


def _tied(a, _u, b, _v):
    return a == b < math.inf


def _with_halves(*given):
    won, lost, undecided = _all_pairs(*given)
    ties = (given[0].isfinite()[:, None] & (given[0][:, None] == given[2])).sum()
    return won + ties / 2, lost + ties / 2, (undecided - ties).float()


_WRONG_RACE_COUNTS = {
    "censored-dropped": (
        _pair_by_pair(_unless(lambda a, _u, b, _v: math.isinf(max(a, b)), lambda *_: None)),
        "Races with a censored run are left out, and with them the slow runs: an algorithm is judged by its successes. They belong to the"
        " n m races, and many of them are decided.",
    ),
    "infinity-is-a-time": (
        _pair_by_pair(lambda a, _u, b, _v: _earlier(a, b)),
        "A censored run loses to everybody who ever crossed, since infinity is later. But it is known to be slower only if it was still"
        " watched then: compare with the end of the *other* run.",
    ),
    "crossed-at-the-end": (
        _pair_by_pair(lambda a, u, b, v: _earlier(min(a, u), min(b, v))),
        "A censored run counts as if it had crossed at its end. Its crossing, if there is one, lies after that: whoever crosses before"
        " the end of a censored run has won, and nothing else is known.",
    ),
    "censored-is-undecided": (
        _pair_by_pair(_unless(lambda a, _u, b, _v: math.isinf(max(a, b)), lambda *_: 0)),
        "Every race with a censored run is undecided here. One that was below the line up to 100,000 steps has lost to one that crossed at"
        " 80,000.",
    ),
    "ties-won": (
        _pair_by_pair(_unless(_tied, lambda *_: 1)),
        "Where both crossed at the same moment nobody was first: a tie is not won. Compare with <, and with ≤ only where an end stands.",
    ),
    "ties-lost": (
        _pair_by_pair(_unless(_tied, lambda *_: -1)),
        "Where both crossed at the same moment nobody was first: a tie is not lost, and in the exchanged order it would be won.",
    ),
    "ties-dropped": (
        _pair_by_pair(_unless(_tied, lambda *_: None)),
        "The three counts do not add up to n m: a race in which both crossed at the same moment has no winner, and counts as undecided.",
    ),
    "ties-halved": (
        _races_of(_with_halves),
        "A tie goes half to each side here, as in a probability of improvement. These are counts of races that were won: a tie is not, and"
        " counts as undecided.",
    ),
    "both-censored-dropped": (
        _pair_by_pair(_unless(_both_censored, lambda *_: None)),
        "The three counts do not add up to n m: a race in which neither crossed is undecided, and counts.",
    ),
    "longer-watched-loses": (
        _pair_by_pair(_unless(_both_censored, lambda _a, u, _b, v: _earlier(u, v))),
        "Of two censored runs the one that was watched longer counts as the slower. Its crossing lies after its end, the other's after an"
        " earlier one: either may be first.",
    ),
    "longer-watched-wins": (
        _pair_by_pair(_unless(_both_censored, lambda _a, u, _b, v: _earlier(v, u))),
        "Of two censored runs the one that was stopped earlier counts as the loser. It is known only that each crosses after its own end:"
        " either may be first.",
    ),
    "at-the-end-is-too-late": (
        _pair_by_pair(_unless(lambda a, u, b, v: (a == v and math.isinf(b)) or (b == u and math.isinf(a)), lambda *_: 0)),
        "A run that crossed at the very moment of the other's last evaluation has won: there the other was seen below the line. ≤ the end,"
        " not <.",
    ),
    "crossing-at-the-own-end-is-censored": (
        _all_after(lambda a, u, b, v: (a.masked_fill(a == u, math.inf), u, b.masked_fill(b == v, math.inf), v)),
        "A run that crossed with its own last evaluation counts as censored. Censored are those whose crossing is infinite.",
    ),
    "our-censored-have-lost": (
        _pair_by_pair(_unless(lambda a, _u, b, _v: a == math.inf > b, lambda *_: -1)),
        "A censored run of theirs is treated rightly, and one of ours has lost to everybody: exchange the sides, and won and lost must"
        " change places. Whether ours had lost by its end depends on our_ends.",
    ),
    "their-censored-have-lost": (
        _pair_by_pair(_unless(lambda a, _u, b, _v: a < math.inf == b, lambda *_: 1)),
        "A censored run of ours is treated rightly, and one of theirs has lost to everybody: exchange the sides, and won and lost must"
        " change places. Whether theirs had lost by its end depends on their_ends.",
    ),
    "seed-against-seed": (
        _pair_by_pair(_by_cases, pairs=zip),
        "Run i races run i only. Seed 3 of one algorithm has nothing to do with seed 3 of another: each of ours races each of theirs, n m"
        " races.",
    ),
    "the-longest-end-for-all": (
        _all_after(lambda a, u, b, v: (a, torch.full_like(u, u.max()), b, torch.full_like(v, v.max()))),
        "All runs of a side are taken to have been watched as long as the longest of them. Each has an end of its own: broadcast the ends"
        " like the crossings.",
    ),
    "the-shortest-end-for-all": (
        _all_after(lambda a, u, b, v: (a, torch.full_like(u, u.min()), b, torch.full_like(v, v.min()))),
        "All runs of a side are taken to have been watched only as long as the shortest of them, and what the others showed is thrown away."
        " Each has an end of its own: broadcast the ends like the crossings.",
    ),
    "all-cut-to-the-shortest": (
        _all_after(lambda *given: _cut_to(min(given[1].min(), given[3].min()), *given)),
        "All runs are cut to the shortest of all before they race, and what the others showed later is thrown away. Each race lasts as long"
        " as its own two runs were watched.",
    ),
    "exchanged": (
        _pair_by_pair(lambda a, u, b, v: -_by_cases(a, u, b, v)),
        "Won and lost are exchanged: the earlier crossing wins, as fewer steps are better.",
    ),
    "undecided-is-all": (
        _races_of(after(ch48.race_counts, lambda counts: (*counts[:2], sum(counts)))),
        "The third count is that of all races. Undecided are those which neither side has won.",
    ),
    "shares": (
        _races_of(lambda *given: tuple(count / given[0].numel() / given[2].numel() for count in ch48.race_counts(*given))),
        "These are shares of all races. Return the counts: 1 of 1 and 25 of 25 are not the same evidence.",
    ),
    "python-ints": (
        after(ch48.race_counts, lambda counts: tuple(count.item() for count in counts)),
        "Return 0-dim tensors, not Python integers: torch.tensor(count), or .sum() of a table of truth values.",
    ),
    "counts-as-floats": (
        after(ch48.race_counts, lambda counts: tuple(count.double() for count in counts)),
        "Counts are whole numbers: the sum of a bool tensor is int64 without a detour by .float().",
    ),
    "crossing-after-the-end-accepted": (
        _only_shapes(_all_pairs),
        "A run cannot be seen to cross after its own end; most often steps have met thousands of steps, or seconds. Refuse it.",
    ),
}

_MIXED = {
    "ours": [(2, 9), (5, 9), (NEVER, 6), (NEVER, 12)],
    "theirs": [(5, 10), (7, 15), (NEVER, 3), (NEVER, 11), (1, 4)],
}
_FOUR = {
    "ours": [(9, 12), (3, 5), (NEVER, 4), (7, 7)],
    "theirs": [(2, 8), (NEVER, 6), (5, 13), (8, 11)],
}


def _moved(name, to):
    """One of the crossings lies after its end."""
    side = {"ours": "our_ends", "theirs": "their_ends"}[name]
    return altered(_races(**_MIXED), lambda given: {name: torch.where(given[name].isfinite(), given[side] + to, given[name])})


RACE_COUNTS = Exercise(
    name="race_counts",
    reference=ch48.race_counts,
    criteria={"values": 1.6, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=drawn_once(
        Case("all cross", _races([(3, 9), (6, 9), (8, 9)], [(4, 9), (5, 9), (7, 9), (1, 9)]), visible=True),
        Case("one of ours crosses between the ends of two of theirs", _races([(6, 9)], [(NEVER, 4), (NEVER, 8)]), visible=True),
        Case("one of theirs crosses between the ends of two of ours", _races([(NEVER, 4), (NEVER, 8)], [(6, 9)]), visible=True),
        Case(
            "none crosses, and the ends differ",
            _races([(NEVER, 3), (NEVER, 8)], [(NEVER, 5)]),
            closed_form=lambda **_given: _counts(0, 0, 2),
            visible=True,
        ),
        Case("ties", _races([(4, 9), (6, 9)], [(4, 8), (6, 9), (2, 9)]), visible=True),
        Case(
            "one crosses at the other's end",
            _races([(5, 9), (NEVER, 5)], [(NEVER, 5), (5, 7)]),
            closed_form=lambda **_given: _counts(1, 1, 2),
            visible=True,
        ),
        Case("runs with ends of their own", _races(**_MIXED), visible=True, draws=2),
        Case("as many of ours as of theirs", _races(**_FOUR), visible=True),
        Case("the sides exchanged", _races(_FOUR["theirs"], _FOUR["ours"])),
        Case("runs that cross with their last step", _races([(4, 4), (7, 7)], [(NEVER, 4), (NEVER, 6), (7, 7)]), visible=True),
        Case("a single race, stopped too early", _races([(3, 9)], [(NEVER, 2)])),
        Case("in seconds", _races(**_MIXED, unit=7.0)),
        Case("races of all kinds", _any_races(), draws=3),
        Case("many races of all kinds", _any_races(n=20, m=30)),
        Case("single precision", _races(**_MIXED), dtype=torch.float32, visible=True),
        Case("ours cross after their ends", _moved("ours", 500.0), raises=["ours", "our_ends"], visible=True, draws=1),
        Case("theirs cross after their ends", _moved("theirs", 500.0), raises=["theirs", "their_ends"], draws=1),
        misshapen(
            "one of our ends for all", _races(**_MIXED), "our_ends", lambda x: x[:1], ["ours", "our_ends"], visible=True, draws=1
        ),
        misshapen("an end of theirs too few", _races(**_MIXED), "their_ends", lambda x: x[1:], ["theirs", "their_ends"], draws=1),
    ),
    misconceptions=(
        *wrong(_WRONG_RACE_COUNTS),
        *spoilt(ch48.race_counts, changed="ours"),
        bad_input_accepted(_races_of(rows_cut(_all_pairs), checked=False)),
    ),
    variants={
        "case by case": _pair_by_pair(_by_cases),
        "all pairs at once": _races_of(_all_pairs),
        "cut to the common window": _races_of(_in_the_common_window),
        "sorted lists": _races_of(_from_sorted),
        "NumPy": _races_of(_in_numpy),
        "Gehan's scores": _races_of(_gehan_scores),
    },
)

# --------------------------------------------------------------------------------------------------- repaired_transitions

_ROWS = ("sent", "rewards", "truncated")


@drawing
def _motor_steps(generator, size=6, dims=2, low=(-1.0, 0.5), high=(3.0, 1.5), reach=1.0):
    """Steps of motors whose commands lie within `reach` of their range around its middle."""
    lower, upper = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    ends = uniform(generator, 2, size) < 0.5
    ends[:, 0], ends[:, -1] = torch.tensor([True, False]), torch.tensor([False, True])
    return {
        "obs": normal(generator, size, 3),
        "sent": 0.5 * (lower + upper) + reach * (uniform(generator, size, dims) - 0.5) * (upper - lower),
        "rewards": normal(generator, size),
        "next_obs": normal(generator, size, 3),
        "terminated": ends[0],
        "truncated": ends[1],
        "low": lower,
        "high": upper,
    }


_rewritten = versions_of(
    ch48.repaired_transitions,
    satisfies(lambda obs, sent, rewards, next_obs: len(obs) == len(sent) == len(rewards) == len(next_obs)),
    one_shape("rewards", "terminated", "truncated"),
    satisfies(lambda low, high: (low < high).all()),
)


def _as_sampled(sent, low, high):
    return 2 * (sent - low) / (high - low) - 1


def _kept(actions=_as_sampled, ended=lambda terminated, truncated: terminated, checked=True, **columns):
    """A version: `actions(sent, low, high)` are those that are kept."""

    def version(obs, sent, rewards, next_obs, terminated, truncated, low, high):
        kept = Transitions(obs, actions(sent, low, high), rewards, next_obs, ended(terminated, truncated))
        return kept._replace(**{name: change(kept) for name, change in columns.items()})

    return _rewritten(version, checked)


def _component_by_component(sent, low, high):
    columns = [(sent[:, i] - (low[i] + high[i]) / 2) / ((high[i] - low[i]) / 2) for i in range(sent.shape[1])]
    return torch.stack(columns, 1)


def _by_interpolation(sent, low, high):
    ends = np.array([-1.0, 1.0])
    columns = [np.interp(sent[:, i].numpy(), [float(low[i]), float(high[i])], ends) for i in range(sent.shape[1])]
    return torch.from_numpy(np.stack(columns, 1)).to(sent.dtype)


_ABOVE = torch.full((2,), 5.0)  # any high
_STUCK = torch.tensor([3.0, 0.5], dtype=torch.float64)  # the second motor's low, too

_WRONG_ACTIONS = {
    "as-sent": (
        lambda sent, low, high: sent.clone(),
        "The buffer keeps what the environment was sent. The policy's actions lie in (-1, 1), and the critic is asked about those: it"
        " has to be taught about actions on the same scale.",
    ),
    "as-clipped": (
        lambda sent, low, high: sent.clamp(-1, 1),
        "Clipping commands to [-1, 1] makes many of them one and the same action, and moves none to where the policy meant it:"
        " undo the scaling.",
    ),
    "to-the-unit-interval": (
        lambda sent, low, high: (sent - low) / (high - low),
        "These actions lie in [0, 1]: half of the range that the policy chooses from is missing.",
    ),
    "bounds-written-in": (
        lambda sent, low, high: 2 * sent - 1,
        "This undoes the scaling of one motor, which takes 0 to 1: low and high say what this one takes.",
    ),
    "divided-by-the-upper-bound": (
        lambda sent, low, high: sent / high,
        "Dividing by the upper bound is right only for bounds that are symmetric around 0.",
    ),
    "not-centred": (
        lambda sent, low, high: 2 * sent / (high - low),
        "The middle of the motor's range is the policy's 0: subtract it before you scale.",
    ),
    "not-scaled": (
        lambda sent, low, high: sent - 0.5 * (low + high),
        "The commands are centred, but not scaled: half of the range is 1.",
    ),
    "half-the-scale": (
        lambda sent, low, high: (sent - 0.5 * (low + high)) / (high - low),
        "Divide by half of the range: these actions reach only from -0.5 to 0.5.",
    ),
    "upside-down": (
        lambda sent, low, high: -_as_sampled(sent, low, high),
        "The lower bound is the policy's -1, the upper one its 1: these are exchanged.",
    ),
    "one-motor's-bounds-for-all": (
        lambda sent, low, high: _as_sampled(sent, low[0], high[0]),
        "Every motor has bounds of its own: low and high are (A,), and broadcast over the steps.",
    ),
    "before-squashing": (
        lambda sent, low, high: _as_sampled(sent, low, high).clamp(-1 + 1e-6, 1 - 1e-6).atanh(),
        "The critic is asked about actions after the hyperbolic tangent, in (-1, 1), not about pre-activations.",
    ),
}

_WRONG_REPAIRED_TRANSITIONS = {
    "truncated-taken-for-terminated": (
        _kept(ended=lambda terminated, truncated: terminated | truncated),
        "A time limit is no end of the task: the critic's target goes on there.",
    ),
    "truncated-instead-of-terminated": (
        _kept(ended=lambda terminated, truncated: truncated),
        "`terminated` is what ends the target. The time limit does not.",
    ),
    "successor-lost": (_kept(next_obs=lambda kept: kept.obs), "next_obs is what the step led to, not what was seen before it."),
    "dtype-lost": (
        after(ch48.repaired_transitions, lambda kept: kept._replace(actions=kept.actions.half())),
        "The actions have lost the dtype of what was sent.",
    ),
}

REPAIRED_TRANSITIONS = Exercise(
    name="repaired_transitions",
    reference=ch48.repaired_transitions,
    criteria={"values": 1.6, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    axes=("step",),
    cases=drawn_once(
        Case("a motor that takes 0 to 1", _motor_steps(dims=1, low=(0.0,), high=(1.0,)), visible=True, draws=2),
        Case("two motors with bounds of their own", _motor_steps(), visible=True, draws=2),
        Case("bounds of -1 and 1", _motor_steps(low=(-1.0, -1.0), high=(1.0, 1.0)), visible=True),
        Case("symmetric bounds", _motor_steps(dims=1, low=(-2.0,), high=(2.0,))),
        Case("as many steps as motors", _motor_steps(size=2)),
        Case("single precision", _motor_steps(), dtype=torch.float32, visible=True),
        Case("low above high", replaced(_motor_steps(), low=_ABOVE), raises=["low", "high"], visible=True, draws=1),
        Case("one motor that cannot move", replaced(_motor_steps(), high=_STUCK), raises=["low", "high"], draws=1),
        *shape_cases(_motor_steps(), _ROWS),
    ),
    misconceptions=(
        *wrong(_WRONG_ACTIONS, _kept),
        *wrong(_WRONG_REPAIRED_TRANSITIONS),
        *spoilt(ch48.repaired_transitions, changed="sent"),
        bad_input_accepted(_kept(checked=False)),
    ),
    variants={
        "from the lower bound": _kept(),
        "component by component": _kept(_component_by_component),
        "interpolation": _kept(_by_interpolation),
        "from the upper bound": _kept(lambda sent, low, high: 1 - (high - sent) / ((high - low) / 2)),
        "a plain tuple": after(_kept(), tuple),
    },
)

EXERCISES = (
    INTERQUARTILE_MEAN,
    BOOTSTRAP_INTERVAL,
    STEPS_TO_THRESHOLD,
    RACE_COUNTS,
    REPAIRED_TRANSITIONS,
)
