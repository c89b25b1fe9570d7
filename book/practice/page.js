// Practice in the page: each exercise's stub that is offered becomes an editor with a check. Without this script the stub stays as it is.
import {bytes, check, data, script, stop} from "./engine.js";
import {Mine} from "./figures.js";
import {Store, read} from "./store.js";

const {version, chapters} = window.coursePractice.index; // the builder writes it before this script
const everyName = Object.values(chapters).flatMap((chapter) => chapter.exercises);
const store = new Store(version);

function element(tag, properties = {}, ...children) {
  const {dataset, ...rest} = properties;
  const made = Object.assign(document.createElement(tag), rest);
  Object.assign(made.dataset, dataset);
  made.append(...children);
  return made;
}

// While it is off, a button does nothing, but keeps the focus of who has pressed it.
const button = (text, does) => element("button", {type: "button", onclick: ({currentTarget}) => off(currentTarget) || does()}, text);
const off = (one) => one.getAttribute("aria-disabled") === "true";
const turn = (one, on) => one.setAttribute("aria-disabled", String(!on));

const cells = [...document.querySelectorAll('div.cell[class*="tag_exercise-"]')].map((cell) => {
  const name = [...cell.classList].find((one) => one.startsWith("tag_exercise-")).slice("tag_exercise-".length);
  return {cell, name};
});
const [assignment, chapter] = Object.entries(chapters).find(([, {exercises}]) => cells.some(({name}) => exercises.includes(name))) ?? [];
const offered = cells.filter(({name}) => chapter?.exercises.includes(name));
const answers = new Map(offered.map(({cell, name}) => [name, new Answer(cell, name)]));

Object.assign(window.coursePractice, {
  data,
  drafts: () => store.everything(everyName).drafts,
  exercises: [...answers.keys()],
  check: async (name, source) => {
    if (!answers.has(name)) throw new Error(`There is no exercise called ${name} on this page.`);
    const {state, misconceptions, message} = await check(assignment, name, source);
    return {state, misconceptions, message};
  },
});

const drafts = () => Object.fromEntries([...answers.keys()].map((name) => [name, store.draft(name)]).filter(([, draft]) => draft !== null));
const figures = [...document.querySelectorAll("figure.explorer")].flatMap((figure) => {
  const title = figure.querySelector("figcaption").textContent, of = chapter?.figures?.[title];
  return of ? [new Mine(figure, {assignment, title, ...of, drafts, element})] : [];
});

// ---- an exercise ------------------------------------------------------------------------------------------------------

function Answer(cell, name) {
  const code = cell.querySelector(".cell_input .highlight");
  const stub = code.querySelector("pre").textContent.trimEnd();
  const help = element("p", {className: "practice-help", id: `practice-help-${name}`, hidden: true},
    "Tab indents; Escape, then Tab, leaves the editor; Ctrl or Cmd and Enter checks.");
  const write = button("Write your answer", () => open(true));
  const tried = button("Check", () => judge());
  const halt = button("Stop", () => stop());
  const reset = button("Reset", () => replace(stub));
  const result = element("div", {className: "practice-result", role: "status"});
  for (const [one, does] of [[tried, "Check"], [halt, "Stop"], [reset, "Reset"]]) one.setAttribute("aria-label", `${does} ${name}`);
  write.setAttribute("aria-label", `Write your answer: ${name}`);
  reset.disabled = true;
  turn(halt, false);
  cell.classList.add("practice");
  cell.append(help, element("div", {className: "practice-bar"}, write, tried, halt, reset), result);
  const reference = cell.nextElementSibling; // what the check says of the reference would be taken for a verdict
  if (reference?.textContent.trim().startsWith(`check(${name})`)) reference.hidden = true;

  let editor, opening;
  const text = () => editor?.text() ?? store.draft(name) ?? stub;

  function open(focus) {
    opening ??= (window.coursePracticeEditor ? Promise.resolve() : script("editor")).then(() => {
      const place = element("div", {className: "practice-editor"});
      code.replaceChildren(place);
      help.hidden = false;
      write.remove();
      reset.disabled = false;
      const changed = (now) => {
        if (now === stub) store.forget(name);
        else store.keep(name, now);
        progress();
      };
      const start = store.draft(name) ?? stub;
      editor = window.coursePracticeEditor({parent: place, text: start, label: `Your answer to ${name}`, help: help.id, changed, check: judge});
    });
    return opening.then(() => focus && editor.focus());
  }

  async function replace(by) {
    await open(false);
    editor.replace(by);
    result.replaceChildren();
  }

  async function judge() {
    if (off(tried)) return;
    turn(tried, false);
    turn(halt, true);
    result.setAttribute("aria-busy", "true");
    const told = (start) => result.replaceChildren(element("p", {className: "practice-wait"}, start || "Running …"));
    try {
      const {[name]: _, ...others} = drafts();
      const verdict = await check(assignment, name, text(), others, told);
      if (verdict.state === "correct") store.pass(name);
      result.replaceChildren(box(name, verdict));
    } catch (error) {
      const sorry = `Python could not be started in this browser (${error.message}). The notebook checks your answer, too.`;
      result.replaceChildren(box(name, {state: "timeout", message: sorry}));
    }
    result.removeAttribute("aria-busy");
    turn(tried, true);
    turn(halt, false);
    progress();
    figures.forEach((figure) => figure.again());
  }

  function follow() {
    const kept = store.draft(name) ?? stub;
    if (editor && editor.text() !== kept) editor.replace(kept);
    else if (!editor && kept !== stub) open(false);
  }

  code.addEventListener("click", () => { if (!editor && getSelection().isCollapsed) open(true); });
  if (store.draft(name) !== null) open(false);
  return {replace, follow, stub};
}

// The verdict as the notebook shows it, whose words come with it.
function box(name, {state, message, headline = `${state === "error" ? "It stops with an error" : "Stopped"}: ${name}`, lines = message.split("\n"), ticks = [], printed = ""}) {
  const mark = {correct: "✓", not_implemented: "…"}[state] ?? "✗";
  return element("div", {className: "course-check", dataset: {state}},
    element("strong", {}, `${mark} ${headline}`),
    ...lines.map((line) => element("div", {}, line)),
    ...(ticks.length ? [element("ul", {}, ...ticks.map((tick) => element("li", {}, tick.join(" "))))] : []),
    ...(printed ? [element("pre", {tabIndex: 0}, printed)] : []));
}

// ---- the page ---------------------------------------------------------------------------------------------------------

const summary = element("span");
const said = element("p", {role: "status", className: "practice-said"});

if (answers.size) {
  const file = element("input", {type: "file", accept: "application/json,.json", hidden: true, tabIndex: -1, onchange: () => load(file)});
  file.setAttribute("aria-label", "A file with drafts");
  const panel = element("div", {className: "practice-panel"},
    element("p", {}, element("strong", {}, "Practise here. "),
      "Write into the exercises of this page and check them: Python runs in the page, and nothing leaves your computer. " +
      "This is practice; points come from the grader, which takes the notebook. " +
      "Chromium and Firefox are tested, Safari is not. ", summary),
    element("div", {className: "practice-bar"},
      button("Take my answers along", () => takeAlong()),
      button("Save drafts to a file", () => save()),
      button("Load drafts from a file", () => file.click()), file),
    said);
  panel.setAttribute("role", "group");
  panel.setAttribute("aria-label", "Practice");
  const title = document.querySelector("article h1");
  (title.parentElement.querySelector(":scope > ul") ?? title).after(panel);
}
progress();
addEventListener("storage", follow);
addEventListener("pageshow", ({persisted}) => persisted && follow());

// Tabs of one page show one text: what is written in one is in the others at once, and a tab that slept is told when it wakes.
function follow() {
  answers.forEach((answer) => answer.follow());
  progress();
}

function progress() {
  const done = [...answers.keys()].filter((name) => store.passed(name)).length;
  summary.textContent = `${done} of ${answers.size} passed here. ${keeping()}`;
  figures.forEach((figure) => figure.update());
  for (const [key, {page, exercises}] of Object.entries(chapters)) {
    const passed = exercises.filter((name) => store.passed(name)).length;
    const here = key === assignment ? ", nav.bd-links li.current.active > a" : "";
    document.querySelectorAll(`nav.bd-links a[href$="${page}.html"], article li a[href$="${page}.html"]${here}`).forEach((link) => {
      link.querySelector(".practice-done")?.remove();
      if (!passed) return;
      const words = element("span", {className: "visually-hidden"}, ` ${passed} of ${exercises.length} exercises passed`);
      const mark = element("span", {}, ` ✓ ${passed}/${exercises.length}`);
      mark.setAttribute("aria-hidden", "true");
      link.append(element("span", {className: "practice-done"}, mark, words));
    });
  }
  overview();
}

// On the front page: what is passed in all, and of each chapter on the map; and the chapter to go on with.
function overview() {
  const place = document.querySelector(".course-progress");
  if (!place) return;
  const each = Object.values(chapters).map(({page, exercises}) => ({
    page,
    of: exercises.length,
    passed: exercises.filter((name) => store.passed(name)).length,
    begun: exercises.some((name) => store.passed(name) || store.draft(name) !== null),
  }));
  for (const {page, of, passed} of each) {
    const link = document.querySelector(`.course-map a[href$="${page}.html"]`);
    if (!link) continue;
    const title = link.querySelector("title").textContent;
    link.setAttribute("aria-label", passed ? `${title}: ${passed} of ${of} exercises passed` : title);
    link.dataset.done = passed === of ? "all" : passed ? "some" : "none";
  }
  const sum = (what) => each.reduce((total, one) => total + one[what], 0);
  const next = each.find(({begun, passed, of}) => begun && passed < of);
  const title = next && document.querySelector(`article li a[href$="${next.page}.html"] strong`).textContent;
  place.replaceChildren(
    ...(next ? [element("a", {href: `chapters/${next.page}.html`}, `Continue with ${title}`), " "] : []),
    `${sum("passed")} of ${sum("of")} exercises on these pages passed. ${keeping()}`);
}

// What becomes of drafts, where that is not what one expects.
function keeping() {
  if (!store.kept) return "This browser keeps nothing for this page: save your drafts to a file before you leave.";
  if (location.origin === "null") return "From disk, this browser keeps each page's drafts for that page alone.";
  return "";
}

function download(name, text, type) {
  const link = element("a", {href: URL.createObjectURL(new Blob([text], {type})), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

function save() {
  download("policy-optimisation-drafts.json", JSON.stringify(store.everything(everyName), null, 1), "application/json");
}

async function load(input) {
  const [chosen] = input.files;
  input.value = "";
  if (!chosen) return;
  try {
    const {drafts, passed} = read(await chosen.text(), everyName);
    const others = drafts.filter(([name, draft]) => (store.draft(name) ?? draft) !== draft).length;
    if (others && !confirm(`${others} of your drafts differ from those in the file. Replace them?`)) return;
    for (const [name, draft] of drafts) {
      store.keep(name, draft);
      await answers.get(name)?.replace(draft);
    }
    passed.forEach((name) => store.pass(name));
    said.textContent = `Loaded ${drafts.length} drafts.`;
  } catch {
    said.textContent = `${chosen.name} holds no drafts of this book.`;
  }
  progress();
}

// The chapter's notebook, with the reader's answers in the places of its stubs.
async function takeAlong() {
  const notebook = JSON.parse(new TextDecoder().decode(await bytes(`${assignment}-notebook`)));
  let taken = 0;
  for (const cell of notebook.cells) {
    const {solution, grade_id: name} = cell.metadata.nbgrader ?? {};
    const draft = solution && answers.has(name) ? store.draft(name) : null;
    if (draft === null) continue;
    cell.source = draft;
    taken += 1;
  }
  download(`${assignment}.ipynb`, JSON.stringify(notebook, null, 1) + "\n", "application/x-ipynb+json");
  said.textContent = `${assignment}.ipynb has ${taken} of your answers. Put it into the folder of your course in the place of the one there.`;
}
