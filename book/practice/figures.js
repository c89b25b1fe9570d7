// "Draw with mine": a figure with sliders draws what the reader's own answers give, over the book's curves.
import {draw, stop} from "./engine.js";

const SLOW = 300; // milliseconds until a figure says that it is drawing
const ALIKE = 1.01e-3; // relative: one unit in the last of the four digits that are kept

export class Mine {
  #figure; #given; #box; #halt; #said;
  #kept = new Map(); // of these answers, what was drawn or said, by the sliders' positions
  #answers = "{}";
  #now; // the sliders' positions
  #busy = false;
  #ahead = true; // whether to draw what is not shown yet

  // `uses` has the exercises that the figure calls, `drawn` of each series those that draw it; `drafts` gives the reader's answers by name.
  constructor(figure, {assignment, title, uses, drawn, drafts, element}) {
    this.#figure = figure;
    this.#given = {assignment, title, uses, drawn, drafts};
    this.#said = element("span", {id: `practice-mine-${title.replace(/\W+/g, "-")}`, role: "status"});
    this.#box = element("input", {type: "checkbox", disabled: true, onchange: () => this.again()});
    this.#box.setAttribute("aria-describedby", this.#said.id);
    this.#halt = element("button", {type: "button", hidden: true, onclick: () => stop()}, "Stop");
    this.#halt.setAttribute("aria-label", `Stop drawing ${title}`);
    figure.querySelector(".controls").after(element("div", {className: "practice-bar practice-mine"},
      element("label", {}, this.#box, "Draw with mine"), this.#halt, this.#said));
    figure.explorer.mine = (positions) => this.#mine(positions);
  }

  // There is something to draw with, or no longer.
  update() {
    const {uses, drafts} = this.#given, own = drafts();
    this.#box.disabled = !uses.some((name) => name in own);
    if (this.#box.disabled && this.#box.checked) this.#off();
    if (this.#box.disabled) this.#say(`First write ${uses.join(" or ")} on this page.`);
    else if (this.#box.checked) this.#tell();
    else if (this.#said.textContent.startsWith("First write ")) this.#say("");
  }

  // The switch was used, or the answers may have changed.
  again() {
    const answers = JSON.stringify(this.#given.drafts());
    if (answers !== this.#answers) this.#kept.clear();
    this.#answers = answers;
    this.#ahead = true;
    if (!this.#box.disabled) this.#say("");
    if (!this.#box.checked) this.#halt.hidden = true;
    this.#figure.explorer.draw();
  }

  // What the figure asks for whenever it is drawn.
  #mine(positions) {
    this.#now = positions;
    if (!this.#box.checked) return null;
    this.#tell();
    this.#ask();
    return this.#kept.get(String(positions))?.values ?? null;
  }

  // What there is to say of the picture, which an edit leaves as it is.
  #tell() {
    const here = this.#kept.get(String(this.#now)), edited = JSON.stringify(this.#given.drafts()) !== this.#answers;
    if (here) this.#say(`${edited ? "From before your last edit; a check draws anew. " : ""}${here.sentence}`);
  }

  // What is to be drawn next: what the figure shows, then what is one step of a slider away.
  #wanted() {
    if (!this.#kept.has(String(this.#now))) return this.#now;
    const sizes = this.#figure.explorer.data.sliders.map(({values}) => values.length);
    const near = this.#now.flatMap((at, i) => [at - 1, at + 1].filter((to) => to >= 0 && to < sizes[i]).map((to) => this.#now.with(i, to)));
    return this.#ahead && near.find((positions) => !this.#kept.has(String(positions)));
  }

  async #ask() {
    if (this.#busy) return;
    this.#busy = true;
    try {
      for (let next; this.#box.checked && (next = this.#wanted());) await this.#one(next);
    } catch (error) {
      this.#off(`Python could not be started in this browser (${error.message}).`);
    }
    this.#busy = false;
  }

  async #one(positions) {
    const {assignment, title} = this.#given, answers = this.#answers, shown = () => String(positions) === String(this.#now);
    let words = "Drawing …", told;
    const tell = () => {
      if (!shown() || !this.#box.checked) return;
      this.#halt.hidden = false;
      this.#say(words);
    };
    const clock = setInterval(tell, SLOW);
    try {
      told = await draw(assignment, title, positions, JSON.parse(answers), (start) => {
        words = start || "Drawing …";
      });
    } finally {
      clearInterval(clock);
      if (document.activeElement === this.#halt) this.#box.focus();
      this.#halt.hidden = true;
    }
    if (answers !== this.#answers) return;
    this.#ahead &&= !told.ended;
    if (told.ended && !this.#box.checked) return;
    if (told.ended && shown()) return this.#off(told.sentence);
    this.#kept.set(String(positions), this.#fitting(positions, told, JSON.parse(answers)));
    if (shown()) this.#figure.explorer.draw();
  }

  // Of what was drawn, the series that the answers draw, with a sentence on them; only a sentence where the figure has no room for it.
  #fitting(positions, {values, sentence}, answers) {
    if (sentence) return {sentence};
    const {data} = this.#figure.explorer, wrong = data.series.findIndex(({x}, i) => x.length !== values[i].length);
    if (wrong >= 0) {
      const {name, x} = data.series[wrong];
      return {sentence: `There is no curve of yours: “${name}” has ${values[wrong].length} values, and the figure draws ${x.length}.`};
    }
    const own = values.map((one, i) => (this.#given.drawn[i].some((name) => name in answers) ? one : null));
    return {values: own, sentence: compared(data, own, data.values[positions.reduce((at, to, i) => at * data.sliders[i].values.length + to, 0)])};
  }

  #off(sentence = "") {
    this.#box.checked = false;
    this.#halt.hidden = true;
    this.#say(sentence);
    this.#figure.explorer.draw();
  }

  #say(sentence) {
    if (this.#said.textContent !== sentence) this.#said.textContent = sentence;
  }
}

// In words, what the picture shows beside the book's curves; `mine` has null for what is the book's alone.
function compared(data, mine, book) {
  const differ = data.series.filter((_, i) => {
    if (!mine[i]) return false;
    const nothing = 1e-6 * Math.max(0, ...book[i].map(Math.abs)); // Math.abs(null) is 0
    return book[i].some((right, j) => {
      const own = mine[i][j];
      return (own === null) !== (right === null) || Math.abs(own - right) > Math.max(nothing, ALIKE * Math.max(Math.abs(own), Math.abs(right)));
    });
  });
  const names = differ.map(({name}) => name).join(", ");
  return `Yours is dashed, the book's is pale. ${names ? `They differ here: ${names}.` : "Here they are the same."}`;
}
