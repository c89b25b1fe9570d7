// The appendix on other libraries (autograder/publishing/atlas_page.py): rows can be filtered and sorted. Without this script all are there.
const tables = [...document.querySelectorAll(".bd-article .atlas-rows table")];
const chapters = new Set(tables.map((table) => table.closest("section").parentElement));
const rows = tables.flatMap((table) => [...table.tBodies[0].rows]);

const form = document.createElement("form");
form.className = "atlas-filter";
form.innerHTML = `
  <label>Show rows with <input type="search" autocomplete="off" placeholder="trl, clip, 0.5 …"></label>
  <label>that are <select autocomplete="off"><option value="">equal or not</option><option value="equal">equal</option>
  <option value="other">not equal</option></select></label>
  <span role="status"></span>`;
const [search, verdict, status] = form.querySelectorAll("input, select, span");
const show = () => {
  const words = search.value.toLowerCase().split(/\s+/).filter(Boolean); // each must begin a word of the row or of its formula's name
  const begins = words.map((word) => new RegExp(`(?<![a-z0-9])${word.replace(/[^a-z0-9]/g, "\\$&")}`));
  let shown = 0;
  for (const row of rows) {
    const section = row.closest("section").querySelector("h3").textContent;
    const text = `${section} ${row.textContent}`.toLowerCase();
    const equal = row.cells[2].textContent.trim().startsWith("equal");
    row.hidden = !begins.every((word) => word.test(text)) || (verdict.value !== "" && (verdict.value === "equal") !== equal);
    shown += !row.hidden;
  }
  for (const table of tables) table.closest("section").hidden = [...table.tBodies[0].rows].every((row) => row.hidden);
  for (const chapter of chapters) chapter.hidden = [...chapter.querySelectorAll(":scope > section")].every((section) => section.hidden);
  status.textContent = `${shown} of ${rows.length} rows`;
};
form.addEventListener("input", show);
form.addEventListener("submit", (event) => event.preventDefault());
if (tables.length) {
  [...chapters][0].before(form);
  show();
}

// A click on a column's head sorts its table by that column, and another one turns it round.
for (const table of document.querySelectorAll(".bd-article table")) {
  const columns = [...table.tHead.rows[0].cells];
  columns.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const turned = head.getAttribute("aria-sort") === "ascending";
      columns.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", turned ? "descending" : "ascending");
      const key = (row) => row.cells[column].textContent.trim().replaceAll("−", "-");
      const order = (a, b) => key(a).localeCompare(key(b), "en", {numeric: true}) * (turned ? -1 : 1);
      table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
    });
  });
}
