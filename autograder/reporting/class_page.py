"""Two pages on a class: `class.html` for the lecture, without a name, and `class-private.html` for the teacher, with them.

The first holds our words, the course's and numbers, and nothing that a student has written or is called; a number of students below
`FEW` is not shown, so that nobody is looked at. That is tact, not secrecy: sums give some of them away. The second has every number.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from jinja2 import Environment
from markupsafe import Markup, escape

from autograder.authoring.assemble import LEVELS, duration
from autograder.grading.verdicts import Verdict, clean_text
from autograder.reporting.class_figures import FEW, OUTCOMES, TENTHS, Figures, Mistake, figures, ordered, people
from autograder.reporting.report import HEAD

COMMONEST = 5  # mistakes on top of the page
ROWS = 300  # of a table of students
BAR, TALL = 300.0, 110.0  # length of a bar, and height of a column, in the pictures' own units

_STYLE = """
:root { color-scheme: light dark; --text: #1c1e21; --page: #fff; --line: #c9ced6; --soft: #f3f5f8; --neutral: #4a5260; --link: #0b57a4;
  --alarm: #a3151f; --all: #12652f; --most: #7cc98f; --some: #efb440; --none: #b3261e; --stopped: #6b3fa0; --untried: #fff;
  --on-dark: #fff; --on-light: #111; }
@media screen and (prefers-color-scheme: dark) { :root { --text: #e6e8eb; --page: #16181c; --line: #434a55; --soft: #22262c;
  --neutral: #b3bac5; --link: #8ab8f0; --alarm: #ff9a94; --all: #1f7a41; --most: #93dba4; --some: #f0b955; --none: #c5372f;
  --stopped: #7d52b3; --untried: #16181c; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1.25rem 4rem; max-width: 76rem; background: var(--page); color: var(--text);
  font: 1.0625rem/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.8rem; line-height: 1.25; margin: 0 0 .5rem; } h2 { font-size: 1.4rem; line-height: 1.3; margin: 3rem 0 .5rem; }
h3 { font-size: 1.1rem; margin: 1.75rem 0 .4rem; } p { margin: .5rem 0; max-width: 46rem; }
a { color: var(--link); } code { font: .92em ui-monospace, monospace; }
.notice { border-left: .3rem solid var(--alarm); background: var(--soft); padding: .6rem .9rem; max-width: none; }
.small, caption { color: var(--neutral); font-size: .94rem; } caption { text-align: left; padding-bottom: .4rem; }
.alarm { color: var(--alarm); font-weight: 600; }
.table { overflow-x: auto; } .table:focus-visible { outline: 2px solid var(--link); }
table { border-collapse: collapse; }
.wide table { width: 100%; }
th, td { text-align: left; vertical-align: top; padding: .45rem 1rem .45rem 0; border-bottom: 1px solid var(--line);
  overflow-wrap: normal; }
tbody th { font-weight: 400; } th { font-size: .94rem; } thead th { vertical-align: bottom; }
.number { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
.picture { width: 30%; min-width: 14rem; } .picture svg { display: block; width: 100%; height: auto; } .exercise { min-width: 17rem; }
thead .number { white-space: normal; }
.mistakes { padding: 0; list-style: none; margin: .5rem 0; }
.mistakes li { display: grid; grid-template-columns: 4.5rem 1fr; gap: 0 1rem; padding: .6rem 0; border-bottom: 1px solid var(--line); }
.mistakes .count { font-size: 1.7rem; font-weight: 600; line-height: 1.3; text-align: right; white-space: nowrap; }
.mistakes p { margin: 0; max-width: 52rem; } .mistakes .say { font-size: 1.15rem; }
.legend { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; margin: .4rem 0 .8rem; padding: 0; list-style: none; }
.legend svg { width: 1rem; height: 1rem; vertical-align: -.15rem; margin-right: .35rem; }
.columns { display: flex; flex-wrap: wrap; gap: 1rem 3rem; align-items: flex-end; }
.columns > svg { flex: 0 1 26rem; min-width: 0; width: 100%; }
svg rect { stroke: var(--neutral); stroke-width: 1; }
svg text { font: 600 13px system-ui, sans-serif; fill: var(--text); text-anchor: middle; }
.all { fill: var(--all); } .most { fill: var(--most); } .some { fill: var(--some); } .none { fill: var(--none); }
.stopped { fill: var(--stopped); } .untried { fill: var(--untried); } .column { fill: var(--most); }
svg text.on-all, svg text.on-none, svg text.on-stopped { fill: var(--on-dark); }
svg text.on-most, svg text.on-some { fill: var(--on-light); }
@media (max-width: 40rem) { body { padding: 1rem .75rem 2rem; font-size: 1rem; } h1 { font-size: 1.45rem; } h2 { font-size: 1.2rem; }
  .mistakes li { grid-template-columns: 3rem 1fr; gap: 0 .7rem; }
  .mistakes .count { font-size: 1.3rem; } .mistakes .say { font-size: 1rem; }
  .exercise { min-width: 10rem; } .picture { min-width: 11rem; } }
@media print { body { max-width: none; padding: 0; font-size: 10pt; } .table { overflow: visible; } nav { display: none; }
  tr, li, svg { break-inside: avoid; } h2, h3 { break-after: avoid; } .picture, .exercise { min-width: 9rem; }
  svg { print-color-adjust: exact; -webkit-print-color-adjust: exact; } th, td { padding-right: .5rem; } }
"""

_PARTS = """
{% macro exercise(stub) %}Exercise {{ stub.number }}: {{ stub.title }} (<code>{{ stub.name | breakable }}</code>){% endmacro %}
{% macro table(label, wide=true) %}<div class="table{{ " wide" if wide }}" role="region" aria-label="{{ label }}" tabindex="0"><table>
{{ caller() }}</table></div>{% endmacro %}
{% macro mistakes(found, of_chapter) %}<p class="small">How many students made each, and what they read about it.</p>
<ol class="mistakes">
{% for one in found %}<li><span class="count">{{ one.students }}</span>
<div><p class="say">{{ one.message | coded }}</p>
<p class="small">{{ of_chapter.get(one.stubs[0].name, "") }}\
{% for stub in one.stubs %}{{ exercise(stub) }}{{ "; " if not loop.last }}{% endfor %} \
· <code>{{ one.name }}</code></p></div></li>
{% endfor %}</ol>{% endmacro %}
{% macro legend() %}<ul class="legend" aria-label="Colours">{% for key, words in outcomes.items() %}
<li><svg viewBox="0 0 16 16" aria-hidden="true"><rect x="1" y="1" width="14" height="14" class="{{ key }}"/></svg>{{ words }}</li>\
{% endfor %}</ul>{% endmacro %}
{% macro lecture(course, few) %}
{% set seen = course | selectattr("graded", "ge", few) | list %}
{% set hard = course | map(attribute="too_hard") | sum(start=[]) %}
{% set top = commonest(course, few) %}
<h2 id="lecture">For the lecture</h2>
{% for one in course %}{% for what, count, of in one.suspicions %}<p class="notice"><strong>{{ one.assignment.name }}, \
{{ count }} of {{ of }} notebooks:</strong> {{ what }}. \
So many seldom share a slip: look at the release, or at the grader, first.</p>{% endfor %}{% endfor %}
{% if not course %}<p>There is no verdict on a chapter of the course yet.</p>
{% elif not seen %}<p>Too few notebooks have been graded to say how exercises went.</p>{% endif %}
{% if hard %}<h3>Too hard</h3>
<ul>{% for one in course %}{% for each in one.too_hard %}<li><a href="#{{ one.assignment.name }}">{{ one.assignment.name }}</a>, \
{{ exercise(each.stub) }}: of those who tried it, {{ each.solved | percent }} have all points. It is announced as \
{{ levels[each.stub.level] }}.</li>{% endfor %}{% endfor %}</ul>
{% elif seen %}<p>No exercise is too hard: of those who tried one, at least half have all its points.</p>{% endif %}
{% if top %}<h3>The most common mistakes</h3>
{{ mistakes(top, chapters_of) }}
{% elif seen %}<p>No mistake that has a name is common.</p>{% endif %}
{% if course | length > 1 %}<h3>Chapters</h3>
{% call table("Chapters", false) %}
<thead><tr><th scope="col">Chapter</th><th scope="col" class="number">Graded</th>\
<th scope="col" class="number">Points earned</th><th scope="col" class="number">Too hard</th></tr></thead>
<tbody>{% for one in course %}<tr><th scope="row"><a href="#{{ one.assignment.name }}">{{ one.assignment.title }}</a></th>
<td class="number">{{ one.graded | people(few) }}</td>
<td class="number">{{ one.share | percent if one.graded >= few else "–" }}</td>\
<td class="number">{{ one.too_hard | length }} of {{ one.exercises | length }}</td></tr>
{% endfor %}</tbody>
{% endcall %}{% endif %}
{% for one in course %}{{ assignment(one, few) }}{% endfor %}
{% endmacro %}
{% macro assignment(one, few) %}
<section>
<h2 id="{{ one.assignment.name }}">{{ one.assignment.title }}</h2>
<p>Of the class, {{ one.handed_in | people(few) }} handed in and {{ one.absent | people(few) }} did not. \
Graded: {{ one.graded | people(few) }}\
{% for key, words in statuses.items() if one.statuses[key] %}; {{ words }}: {{ one.statuses[key] | people(few) }}{% endfor %}.</p>
{% if one.unknown %}<p class="notice">Some outcomes are of exercises or mistakes that the course no longer has, and are left out: \
grade again.</p>{% endif %}
{% if one.graded and one.graded < few %}<p>These are too few for a picture that everybody sees.</p>
{% elif one.graded %}
<h3>Points</h3>
<p>On average {{ one.share | percent }} of the points of its exercises.</p>
<div class="columns">{{ one.totals | columns(few) }}
{% call table("Points of " ~ one.assignment.name, false) %}
<caption>Notebooks by their share of the points</caption>
<thead><tr><th scope="col">Points</th><th scope="col" class="number">Notebooks</th></tr></thead>
<tbody>{% for label in tenths %}<tr><th scope="row">{{ label }}</th><td class="number">{{ one.totals[label] | few(few) }}</td></tr>
{% endfor %}</tbody>
{% endcall %}</div>
<h3>Exercises</h3>
{{ legend() }}
<p class="small">Notebooks by outcome. What needs the lecture comes first.</p>
{% call table("Exercises of " ~ one.assignment.name) %}
<thead><tr><th scope="col">Exercise</th><th scope="col">Outcome</th>{% for words in outcomes.values() %}\
<th scope="col" class="number">{{ words | capitalize }}</th>{% endfor %}<th scope="col" class="number">Points earned</th></tr></thead>
<tbody>{% for each in one.exercises if each.notebooks %}<tr><th scope="row" class="exercise">{{ exercise(each.stub) }}<br>
<span class="small">{{ levels[each.stub.level] }}, {{ each.stub.minutes | duration }}</span>
{% if each.too_hard %}<br><span class="alarm">too hard: solved by {{ each.solved | percent }} of those who tried</span>
{% elif each.left_out %}<br><span class="alarm">left out by most</span>{% endif %}</th>
<td class="picture">{{ each.counts | bar(few) }}</td>
{% for key in outcomes %}<td class="number">{{ each.counts[key] | few(few) }}</td>{% endfor %}
<td class="number">{{ each.share | percent }}</td></tr>
{% endfor %}</tbody>
{% endcall %}
{% set common = one.mistakes | selectattr("students", "ge", few) | list %}
{% set rare = one.mistakes | selectattr("students", "lt", few) | list %}
{% if common or rare %}<h3>Mistakes</h3>{% endif %}
{% if common %}{{ mistakes(common, {}) }}{% endif %}
{% if rare %}<p class="small">{{ rare | length }} {{ "more " if common }}mistake{{ "s" if rare | length > 1 }} with a name \
{{ "have" if rare | length > 1 else "has" }} been made by fewer than {{ few }} students{{ " each" if rare | length > 1 }}.</p>{% endif %}
{% endif %}
{% if one.causes and (one.handed_in >= few) %}<h3>What came between an answer and its points</h3>
{% call table("Causes in " ~ one.assignment.name, false) %}
<thead><tr><th scope="col">In a notebook</th><th scope="col" class="number">Notebooks</th></tr></thead>
<tbody>{% for cause, count in one.causes | ordered if count >= few %}<tr><th scope="row">{{ cause }}</th>\
<td class="number">{{ count }}</td></tr>{% endfor %}
{% set rest = one.causes.values() | select("lt", few) | list | length %}
{% if rest %}<tr><th scope="row">{{ rest }} more, each in a few notebooks</th><td class="number">&lt; {{ few }}</td></tr>{% endif %}</tbody>
{% endcall %}{% endif %}
</section>
{% endmacro %}
{% macro persons(title, rule, head, rows) %}{% if rows %}<h3>{{ title }}</h3>
<p class="small">{{ rule }}</p>
{% call table(title) %}
<thead><tr>{% for one in head %}<th scope="col">{{ one }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in rows[:most] %}<tr><th scope="row"><bdi>{{ row[0] }}</bdi></th>\
{% for one in row[1:] %}<td><bdi>{{ one | brief }}</bdi></td>{% endfor %}</tr>
{% endfor %}</tbody>
{% endcall %}
{% if rows | length > most %}<p>… and {{ rows | length - most }} more.</p>{% endif %}
{% endif %}{% endmacro %}
"""

_PAGE = (
    _PARTS
    + HEAD
    + """<title>{{ "The class, with names" if private else "The class" }}</title>
<style>{{ style }}</style>
</head>
<body>
<main>
{% if private %}
<h1>The class, with names</h1>
<p class="notice"><strong>Not for the projector.</strong> Names first, then every number of \
<a href="class.html">the page for the lecture</a>, small ones included.</p>
<h2>Who needs help</h2>
{{ persons("Grading failed", "The grader's fault, not theirs: grade again, or see `course doctor`." | coded,
  ("Student", "Assignment", "Why"), who.ungraded) }}
{{ persons("To be reviewed", "The points are provisional until `course accept STUDENT ASSIGNMENT`." | coded,
  ("Student", "Assignment", "Why"), who.review) }}
{{ persons("No notebook to grade", "Ask for another file, and grade again.", ("Student", "Assignment", "Why"), who.unreadable) }}
{{ persons("Nothing handed in", "In the gradebook, or with a folder of no chapter, and without a chapter so far.",
  ("Student",), who.nothing | map("list_of") | list) }}
{{ persons("Fallen behind", "Chapters that at least half of the class has handed in, and they have not.",
  ("Student", "Missing", "Which"), who.missing) }}
{{ persons("Few points", "Under half of the automatic points of what they handed in; the fewest first.",
  ("Student", "Points", "Tried, without all points"), who.few_points) }}
{% if not (who.ungraded or who.review or who.unreadable or who.nothing or who.missing or who.few_points) %}<p>Nobody, by these \
rules: all was graded, nothing is missing that half of the class has handed in, and nobody has under half of the points.</p>{% endif %}
{{ lecture(course, 1) }}
{% else %}
<h1>The class</h1>
<p>What {{ students | people(few) }} students made of the exercises, as they were graded automatically. An exercise is \
<em>too hard</em> if fewer than half of those who tried it, and at least {{ few }} did, have all its points. \
Nobody is named here, and where there are fewer than {{ few }} students, there is no number.</p>
{{ lecture(course, few) }}
{% endif %}
</main>
</body>
</html>
"""
)


# --- numbers and pictures ----------------------------------------------------------------------------------------------------


def _people(number: int, least: int) -> str:
    """A number of students in a sentence."""
    return str(number) if number == 0 or number >= least else f"fewer than {least}"


def _few(number: int, least: int) -> str:
    """The same in a table."""
    return str(number) if number == 0 or number >= least else f"< {least}"


def _drawn(counts: Mapping[str, int], least: int) -> dict[str, float]:
    """Sizes to draw: a small number, which no length may tell either, as half of the least that is shown."""
    return {key: float(n) if n == 0 or n >= least else least / 2 for key, n in counts.items()}


def picture_of_outcomes(counts: Mapping[str, int], least: int) -> Markup:
    """Outcomes side by side, with their numbers where there is room."""
    sizes = _drawn({key: counts.get(key, 0) for key in OUTCOMES}, least)
    told = ", ".join(f"{words} {_people(counts[key], least)}" for key, words in OUTCOMES.items() if counts.get(key))
    parts, x, total = [], 1.0, sum(sizes.values()) or 1.0
    for key, size in sizes.items():
        width = BAR * size / total
        if not size:
            continue
        parts.append(f'<rect x="{x:.1f}" y="1" width="{width:.1f}" height="26" class="{key}"/>')
        if counts[key] >= least and width >= 24:
            parts.append(f'<text x="{x + width / 2:.1f}" y="19" class="on-{key}">{counts[key]}</text>')
        x += width
    return _picture(BAR + 2, 28, told, parts)


def picture_of_points(totals: Mapping[str, int], least: int) -> Markup:
    """How many notebooks have which share of the points."""
    sizes = _drawn({key: totals.get(key, 0) for key in TENTHS}, least)
    told = "Share of the points: " + ", ".join(f"{key} {_people(totals.get(key, 0), least)}" for key in TENTHS)
    step, largest, parts = BAR / len(TENTHS), max(sizes.values()) or 1.0, []
    for place, (key, size) in enumerate(sizes.items()):
        x, tall = 1 + step * place, TALL * size / largest
        middle = x + step / 2
        if size:
            parts.append(
                f'<rect x="{x + 4:.1f}" y="{20 + TALL - tall:.1f}" width="{step - 8:.1f}" height="{tall:.1f}" class="column"/>'
            )
        parts.append(f'<text x="{middle:.1f}" y="{14 + TALL - tall:.1f}">{escape(_few(totals.get(key, 0), least))}</text>')
        parts.append(f'<text x="{middle:.1f}" y="{TALL + 36:.1f}">{key.rstrip("%")}</text>')
    return _picture(BAR + 2, TALL + 42, told, parts)


def _picture(width: float, height: float, told: str, parts: Sequence[str]) -> Markup:
    label = escape(told)
    return Markup(f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{label}">{"".join(parts)}</svg>')


def _commonest(course: Sequence[Figures], least: int) -> list[Mistake]:
    """The mistakes that most students made, over all chapters."""
    found = [one for each in course if each.graded >= least for one in each.mistakes if one.students >= max(least, 2)]
    return sorted(found, key=lambda one: -one.students)[:COMMONEST]  # equal ones in the course's order


def _coded(text: str) -> Markup:
    """Text with what stands between backticks as code."""
    pieces = [escape(piece) for piece in re.split("`([^`]*)`", text)]
    return Markup("").join(Markup(f"<code>{piece}</code>") if place % 2 else piece for place, piece in enumerate(pieces))


_environment = Environment(autoescape=True, trim_blocks=True)
_environment.filters |= {
    "bar": picture_of_outcomes,
    "breakable": lambda name: Markup("_<wbr>").join(name.split("_")),
    "brief": lambda text: clean_text(text, 160),
    "coded": _coded,
    "columns": picture_of_points,
    "duration": duration,
    "few": _few,
    "list_of": lambda one: (one,),
    "ordered": ordered,
    "people": _people,
    "percent": lambda share: f"{share:.0%}",
}
_template = _environment.from_string(_PAGE)


def class_pages(verdicts: Sequence[Verdict], roster: Mapping[str, str] = MappingProxyType({})) -> dict[str, str]:
    """File name → page: `class.html` for the lecture and `class-private.html` for the teacher.

    Args:
      verdicts: all there are, sorted by student and assignment; the same ones give the same pages.
      roster: student → name, for the teacher's page; of people, too, who have handed in nothing.
    """
    students = {verdict.student for verdict in verdicts} | set(roster)
    course = figures(verdicts, len(students))
    common: dict[str, Any] = {
        "course": course,
        "students": len(students),
        "few": FEW,
        "most": ROWS,
        "outcomes": OUTCOMES,
        "tenths": TENTHS,
        "levels": LEVELS,
        "statuses": {"needs_review": "to be reviewed", "student_error": "no notebook", "infra_error": "grading failed"},
        "commonest": _commonest,
        "chapters_of": {name: f"{one.assignment.name}, " for one in course for name in one.assignment.stubs},
        "style": Markup(_STYLE),
        "style_hash": base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode(),
    }
    who = people(verdicts, students, course, roster)
    return {
        "class.html": _template.render(common, private=False).lstrip(),
        "class-private.html": _template.render(common, private=True, who=who).lstrip(),
    }
