from pathlib import Path

import pytest

from autograder.authoring import markdown
from autograder.authoring.bibliography import Bibliography

BIBLIOGRAPHY = Bibliography(Path(__file__).parents[1] / "fixtures" / "references.bib")


def _render(text, kind=markdown.Plain):
    equations = {label: f"44.{number}" for number, (label, _) in enumerate(markdown.labels(text), 1)}
    return markdown.render(text, kind("ch44", equations, BIBLIOGRAPHY, {43: "ch43_ppo"}))


@pytest.mark.parametrize("kind", [markdown.Plain, markdown.Book])
@pytest.mark.parametrize(
    "text",
    [
        "",
        "Plain *text*.\n\n- a list\n- `{eq}`",
        "```python\n:::{nothing}\n$\n```",
        "`` {cite:t}`x` `` and $a_{t}$ and \\$5",
        "a | b\n--|--\n1 | 50 %",
    ],
)
def test_plain_markdown_passes_unchanged(text, kind):
    assert _render(text, kind) == text


def test_a_dropdown_becomes_details_with_its_markdown_alive():
    assert _render(":::{dropdown} See `x` < y\nThe *answer*.\n:::") == (
        "<details>\n<summary>See <code>x</code> &lt; y</summary>\n\nThe *answer*.\n\n</details>"
    )
    assert _render(":::{tip} t\n:class: dropdown\nx\n:::").startswith("<details>")


@pytest.mark.parametrize(
    "text, expected",
    [
        (":::{note}\nOne.\n\nTwo.\n:::", "> **Note**\n>\n> One.\n>\n> Two."),
        (":::{admonition} Mind $x$\n:class: tip\nOne.\n:::", "> **Mind $x$**\n>\n> One."),
        (":::{margin}\nAside.\n:::", "> Aside."),
        (":::{note}\nA sum $a\n+ b$:\n\n$$\na\n= b\n$$\n:::", "> **Note**\n>\n> A sum $a + b$:\n>\n> $$ a = b $$"),
    ],
)
def test_admonitions_and_margin_notes_become_quotations_with_formulas_on_one_line(text, expected):
    assert _render(text) == expected


QUIZ = """:::{quiz} Which `end`, $d_t$?
Mind $T$.

- [ ] `a: b` or $x: y$: It bootstraps,
  see {eq}`one`.
- [x] the other: Nothing follows: nothing.
:::"""


def test_a_quiz_in_a_notebook_is_a_list_and_a_fold():
    assert _render(f"{QUIZ}\n\n$$ a $$ (one)").startswith(
        "**Question.** Which `end`, $d_t$?\n\nMind $T$.\n\n- **A.** `a: b` or $x: y$\n- **B.** the other\n\n"
        "<details>\n<summary>Answer</summary>\n\n- **A.** **Wrong.** It bootstraps, see (44.1).\n"
        "- **B.** **Right.** Nothing follows: nothing.\n\n</details>\n"
    )


def test_a_quiz_in_the_book_is_a_list_and_a_fold_for_the_script_to_wire():
    assert _render(f"{QUIZ}\n\n$$ a $$ (one)", markdown.Book).startswith(
        ":::{div} quiz\n\nWhich `end`, $d_t$?\n\nMind $T$.\n\n1. `a: b` or $x: y$\n1. the other\n\n```{dropdown} Answer\n"
        '1. <strong class="quiz-wrong">Wrong.</strong> It bootstraps, see [(44.1)](#eq-ch44-one).\n'
        '1. <strong class="quiz-right">Right.</strong> Nothing follows: nothing.\n```\n:::\n'
    )


@pytest.mark.parametrize("link", ["[chapter 43](chapter:43)", "{eq}`loss`", "{cite:t}`schulman2017`"])
def test_a_folds_title_holds_no_link(link):
    with pytest.raises(markdown.MarkdownError, match="holds no link") as caught:
        _render(f"x\n\n:::{{dropdown}} See {link}\ny\n:::")
    assert caught.value.line == 3


@pytest.mark.parametrize(
    "text, line, message",
    [
        (":::{quiz} Q?\n- [ ] a: b\n- [ ] c: d\n:::", 1, "exactly one answer .* has 0"),
        (":::{quiz} Q?\n- [x] a: b\n- [ ] c: d\n- [x] e: f\n:::", 4, "exactly one answer .* has 2"),
        ("x\n\n:::{quiz} Q?\n- [x] a: b\n- [ ] c\n:::", 5, "explains itself"),
        (":::{quiz} Q?\n- [ ] a: b\n- [x] `c: d`\n:::", 3, "explains itself"),
        (":::{quiz}\n- [x] a: b\n- [ ] c: d\n:::", 1, "question on its first line"),
        (":::{quiz} Q?\n- [x] a: b\n:::", 1, "at least two"),
        (":::{quiz} Q?\nNo answers.\n:::", 1, "at least two"),
        (":::{quiz} Q?\n- [x] a: b\n- [X] c: d\n:::", 3, "or \\[x\\] for the right one"),
        (":::{quiz} Q?\n- [x] a: b\nwords\n- [ ] c: d\n:::", 3, "or \\[x\\] for the right one"),
        (":::{quiz} Q?\n\n- [x] a: b\n- [ ] c: {ref}`d`\n:::", 4, "unknown role"),
    ],
)
def test_a_quiz_that_is_not_one_is_refused_with_its_line(text, line, message):
    with pytest.raises(markdown.MarkdownError, match=message) as caught:
        _render(text)
    assert caught.value.line == line


def test_equations_are_numbered_by_chapter_and_referred_to_by_number():
    text = "$$ a = b $$ (one)\n\n:::{math}\n:label: two\n\nc\n:::\n\n{eq}`two` follows {eq}`one`."
    assert _render(text) == "$$\na = b\n\\tag{44.1}\n$$\n\n$$\nc\n\\tag{44.2}\n$$\n\n(44.2) follows (44.1)."
    book = _render(text, markdown.Book)
    assert "(eq-ch44-two)=\n```{math}\n:nowrap:" in book
    assert book.endswith("[(44.2)](#eq-ch44-two) follows [(44.1)](#eq-ch44-one).")


def test_labels_inside_directives_count_in_reading_order_with_their_lines():
    text = "$$ a $$ (one)\n\n::::{dropdown} x\n:class: y\n\n:::{note}\n$$ b $$ (two)\n:::\n::::\n\n$$ c $$ (three)"
    assert list(markdown.labels(text, line=10)) == [("one", 10), ("two", 16), ("three", 20)]


def test_links_to_chapters_lead_to_pages_and_notebooks_or_stay_words():
    text = "[one](chapter:43) and [two](chapter:97)"
    assert _render(text) == "[one](../ch43/ch43.ipynb) and two"
    assert _render(text, markdown.Book) == "[one](ch43_ppo.ipynb) and two"


def test_links_to_appendices_lead_to_pages_and_stay_words_in_notebooks():
    text = "see [the signs](appendix:notation)"
    assert _render(text, markdown.Book) == "see [the signs](../notation.md)"
    assert _render(text) == "see the signs"


def test_links_to_the_atlas_lead_to_a_formulas_table_and_stay_words_in_notebooks():
    text = "[skrl 2.1.1](atlas:clip_fraction/skrl/equal)"
    assert _render(text, markdown.Book) == "[skrl 2.1.1](#atlas-clip-fraction)"
    assert _render(text) == "skrl 2.1.1"
    with pytest.raises(markdown.MarkdownError, match="a link to a row of the atlas is written"):
        _render("(atlas:clip_fraction)")
    with pytest.raises(markdown.MarkdownError, match="a fold's title holds no link"):
        _render(f":::{{dropdown}} {text}\nx\n:::")


def test_citations_are_words_in_notebooks_and_prefixed_keys_in_the_book():
    text = "{cite:t}`sutton2018` ({cite:p}`schulman2016, sutton2018`)"
    assert _render(text) == "Sutton and Bärto (2018) ((Schulman et al., 2016; Sutton and Bärto, 2018))"
    assert _render(text, markdown.Book) == "{cite:t}`ch44-sutton2018` ({cite:p}`ch44-schulman2016,ch44-sutton2018`)"


@pytest.mark.parametrize(
    "text, line, message",
    [
        ("a\n\n:::{figure} x\n:::", 3, "unknown directive {figure}"),
        ("a\n\n```{note}\nx\n```", 3, "write directives with colons"),
        ("a {ref}`b`", 1, "unknown role {ref}"),
        ("a\n{eq}`b`", 2, "no equation of this chapter is labelled 'b'"),
        ("a\n{cite:t}`nobody`", 2, "'nobody' is not in references.bib"),
        (":::{note}\nx", 1, "this {note} is not closed"),
        ("x\n:::", 2, "opens or closes nothing"),
        ("- x\n  :::{note}\n  :::", 2, "opens or closes nothing"),
        (":::{note}\n:clas: x\n:::", 2, "unknown option :clas:"),
        ("::::{note}\n\n:::{dropdown} x\n{ref}`y`\n:::\n::::", 4, "unknown role"),
        ("(label)=\n# x", 1, "targets"),
        ("x\n% y", 2, "comments"),
        ("x[^1]", 1, "footnotes"),
        ("$$ a $$ in words", 1, "not closed, on a line's end"),
        ("words $$ a $$", 1, "no partner"),
        ("$$\na", 1, "not closed"),
        ("costs $5", 1, "no partner"),
        ("$$\n\\begin{align}\na\n\\end{align}\n$$", 1, "aligned"),
        ("```\nx", 1, "code block is not closed"),
        ("### BEGIN SOLUTION", 1, "nbgrader"),
    ],
)
def test_what_the_dialects_do_not_know_is_refused_with_its_line(text, line, message):
    with pytest.raises(markdown.MarkdownError, match=message) as caught:
        _render(text)
    assert caught.value.line == line
