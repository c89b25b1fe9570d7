// Paper is white, whatever the screen is.
const paper = matchMedia("print");
let screenTheme;
paper.addEventListener("change", () => {
  const root = document.documentElement;
  if (paper.matches) screenTheme = root.dataset.theme;
  root.dataset.theme = paper.matches ? "light" : screenTheme;
});

// Makes a form of each quiz. The page holds the question, the answers as one list and the explanations as a second, folded one
// (autograder/authoring/markdown.py); what Sphinx and MathJax have rendered is moved, never copied. Without this script the fold remains.
document.querySelectorAll("div.quiz").forEach((quiz, number) => {
  const fold = quiz.querySelector(":scope > details");
  const answers = quiz.querySelector(":scope > ol");
  const explanations = [...fold.querySelectorAll("ol > li")].map((item) => {
    const explanation = document.createElement("div");
    explanation.append(...item.childNodes);
    return explanation;
  });
  const form = document.createElement("fieldset");
  const legend = form.appendChild(document.createElement("legend"));
  legend.append(...quiz.querySelector(":scope > p").childNodes);
  quiz.querySelector(":scope > p").remove();
  form.append(...[...quiz.childNodes].filter((node) => node !== fold && node !== answers));
  const verdict = document.createElement("div");
  verdict.className = "quiz-verdict";
  verdict.setAttribute("role", "status");
  const store = document.createElement("div"); // the explanations that are not shown, where MathJax finds them
  store.hidden = true;
  store.append(...explanations);

  [...answers.children].forEach((item, index) => {
    const label = form.appendChild(document.createElement("label"));
    const input = label.appendChild(document.createElement("input"));
    Object.assign(input, {type: "radio", name: `quiz-${number}`, autocomplete: "off"});
    const text = label.appendChild(document.createElement("span"));
    text.append(...(item.querySelector(":scope > p") ?? item).childNodes);
    input.addEventListener("change", () => {
      store.append(...verdict.childNodes);
      verdict.append(explanations[index]);
      verdict.dataset.right = explanations[index].querySelector(".quiz-right") !== null;
    });
  });
  form.append(verdict, store);
  quiz.replaceChildren(form);
});
