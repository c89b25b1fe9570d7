"""The learner's report: one HTML page for each submission, self-contained, readable in light and dark and on a phone.

Text from submissions is escaped by the template engine; besides, the page's own policy forbids it to run or load anything.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

from jinja2 import Environment
from markupsafe import Markup

from autograder.grading.verdicts import FINAL, Verdict

if TYPE_CHECKING:
    from autograder.reporting.gradebook import Mark

STATE_WORDS = {
    "correct": "correct",
    "partial": "partly correct",
    "wrong": "not correct",
    "not_implemented": "not implemented yet",
    "error": "stopped with an error",
    "timeout": "ran out of time",
    "manual": "graded by hand",
}
STATUS_WORDS = {
    "graded": "",
    "student_error": "This submission could not be graded, so it earns no points. Correct what is listed below and submit again.",
    "needs_review": "A teacher has to look at this submission. The points below are provisional and count only after that.",
    "infra_error": "Grading failed for a reason that is not yours. No score has been recorded; it will be tried again.",
}


def points(value: float) -> str:
    """A number of points as people write it: 7, 2.5."""
    return f"{round(value, 2):g}"


_STYLE = """
:root { color-scheme: light dark; --text: #1c1e21; --page: #fff; --line: #c9ced6; --soft: #f3f5f8;
  --correct: #12652f; --partial: #7a4f00; --wrong: #a3151f; --neutral: #4a5260; }
@media (prefers-color-scheme: dark) { :root { --text: #e6e8eb; --page: #16181c; --line: #434a55; --soft: #22262c;
  --correct: #6fd28c; --partial: #f0b955; --wrong: #ff9a94; --neutral: #b3bac5; } }
body { margin: 0 auto; padding: 1.5rem 1rem 3rem; max-width: 46rem; background: var(--page); color: var(--text);
  font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.4rem; margin: 0; }
h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: 1.5rem 0 .25rem; }
h3 code { font-weight: 600; }
p { margin: .5rem 0; } .score { font-size: 1.6rem; font-weight: 600; margin: .75rem 0 0; }
.notice { border-left: .3rem solid var(--wrong); background: var(--soft); padding: .6rem .9rem; }
table { border-collapse: collapse; width: 100%; } caption { text-align: left; color: var(--neutral); padding-bottom: .4rem; }
th, td { text-align: left; vertical-align: top; padding: .45rem .6rem .45rem 0; border-bottom: 1px solid var(--line); }
tbody th { font-weight: 400; }
td:last-child, th:last-child { text-align: right; white-space: nowrap; padding-right: 0; }
code { font: .95em ui-monospace, monospace; } a { color: inherit; }
pre { font: .9rem/1.45 ui-monospace, monospace; white-space: pre-wrap; unicode-bidi: isolate; background: var(--soft);
  margin: .4rem 0; padding: .6rem .8rem; }
.state { font-weight: 600; }
.correct { color: var(--correct); }
.partial { color: var(--partial); }
.wrong, .error, .timeout { color: var(--wrong); }
.manual, .not_implemented { color: var(--neutral); }
@media (max-width: 30rem) { body { padding: 1rem .75rem 2rem; } }
"""

# of every page that is handed out: they load and send nothing
HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" \
content="default-src 'none'; style-src 'sha256-{{ style_hash }}'; base-uri 'none'; form-action 'none'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="referrer" content="no-referrer">
"""
_PAGE = (
    HEAD
    + """<title>{{ verdict.assignment }}: {{ verdict.student }}</title>
<style>{{ style }}</style>
</head>
<body>
<main>
<h1><bdi>{{ verdict.assignment }}</bdi>, submitted by <bdi>{{ verdict.student }}</bdi></h1>
{% if verdict.status != "infra_error" %}<p class="score">{{ verdict.score | points }} of {{ verdict.max_score | points }} points\
{{ " (provisional)" if verdict.status == "needs_review" }}</p>{% endif %}
{% if verdict.manual_max_score %}<p>Open questions, graded by hand: \
{% if verdict.manual_score is none %}not graded yet, {{ verdict.manual_max_score | points }} points possible\
{% else %}{{ verdict.manual_score | points }} of {{ verdict.manual_max_score | points }} points{% endif %}.</p>{% endif %}
{% if status_words %}<p class="notice">{{ status_words }}</p>{% endif %}
{% if verdict.flags %}
<h2>Notes on this submission</h2>
<ul>{% for flag in verdict.flags %}<li><bdi>{{ flag }}</bdi></li>{% endfor %}</ul>
{% endif %}
{% if verdict.items %}
<h2>Exercises</h2>
<table>
<caption>Each exercise with its outcome. A linked outcome is explained below.</caption>
<thead><tr><th scope="col">Exercise</th><th scope="col">Outcome</th><th scope="col">Points</th></tr></thead>
<tbody>
{% for item in verdict.items %}
<tr><th scope="row"><code>{{ item.exercise | breakable }}</code></th>
<td class="state {{ item.state }}">
{%- if item in explained %}<a href="#exercise-{{ loop.index }}">{{ words[item.state] }}</a>
{%- else %}{{ words[item.state] }}{% endif %}</td>
<td>{{ "–" if scores[loop.index0] is none else scores[loop.index0] | points }} / {{ item.max_score | points }}</td></tr>
{% endfor %}
</tbody>
</table>
{% endif %}
{% if explained %}
<h2>What to look at</h2>
{% for item in verdict.items %}{% if item in explained %}
<section>
<h3 id="exercise-{{ loop.index }}"><code>{{ item.exercise }}</code>: \
<span class="{{ item.state }}">{{ words[item.state] }}</span></h3>
{% if item.message %}<pre>{{ item.message }}</pre>{% endif %}
{% if item.misconceptions %}<p>Recognised:
{% for name in item.misconceptions %}<code>{{ name }}</code>{{ ", " if not loop.last }}{% endfor %}</p>{% endif %}
</section>
{% endif %}{% endfor %}
{% endif %}
</main>
</body>
</html>
"""
)

_environment = Environment(autoescape=True, trim_blocks=True)
_environment.filters["points"] = points
_environment.filters["breakable"] = lambda name: Markup("_<wbr>").join(name.split("_"))  # long names on a phone; join escapes
_template = _environment.from_string(_PAGE)


def report_html(verdict: Verdict, marks: Sequence[Mark] = ()) -> str:
    """A page for the learner: self-contained, without scripts, and forbidden by its own policy to load or run anything.

    `marks` are the gradebook's, where a teacher has given points for open questions."""
    given = {mark.cell: mark.score for mark in marks if mark.question and verdict.status in FINAL}
    return _template.render(
        scores=[given.get(item.exercise) if item.state == "manual" else item.score for item in verdict.items],
        verdict=verdict,
        words=STATE_WORDS,
        status_words=STATUS_WORDS[verdict.status],
        explained=[item for item in verdict.items if item.message or item.misconceptions],
        style=Markup(_STYLE),
        style_hash=base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode(),
    )
