// The editor of an answer: CodeMirror, in the colours of the page's other code, whose class names its tokens get.
import {defaultKeymap, history, historyKeymap, indentWithTab, isolateHistory} from "@codemirror/commands";
import {pythonLanguage} from "@codemirror/lang-python";
import {bracketMatching, indentOnInput, indentUnit, syntaxHighlighting, HighlightStyle} from "@codemirror/language";
import {EditorState, Prec} from "@codemirror/state";
import {EditorView, keymap} from "@codemirror/view";
import {tags} from "@lezer/highlight";

const colours = HighlightStyle.define([
  {tag: tags.comment, class: "c1"},
  {tag: tags.string, class: "s2"},
  {tag: tags.special(tags.string), class: "s2"},
  {tag: [tags.number, tags.float, tags.integer], class: "mi"},
  {tag: [tags.bool, tags.null], class: "kc"},
  {tag: [tags.keyword, tags.controlKeyword, tags.definitionKeyword, tags.moduleKeyword], class: "k"},
  {tag: tags.operatorKeyword, class: "ow"},
  {tag: [tags.operator, tags.arithmeticOperator, tags.compareOperator, tags.logicOperator, tags.bitwiseOperator], class: "o"},
  {tag: tags.function(tags.definition(tags.variableName)), class: "nf"},
  {tag: tags.meta, class: "nd"},
]);

const look = EditorView.theme({
  "&": {backgroundColor: "transparent", color: "inherit"},
  "&.cm-focused": {outline: "none"},
  ".cm-scroller": {fontFamily: "var(--pst-font-family-monospace)", fontSize: ".75rem", lineHeight: "1.4"},
  ".cm-content": {caretColor: "var(--pst-color-text-base)", padding: ".6rem 0"},
  ".cm-line": {padding: "0 .6rem"},
  "&.cm-focused .cm-matchingBracket": {backgroundColor: "transparent", outline: "1px solid currentColor"},
});

// An editor in `parent`. `changed` is called with each new text; `check` when the reader presses Ctrl or Cmd and Enter.
window.coursePracticeEditor = ({parent, text, label, help, changed, check}) => {
  const view = new EditorView({
    parent,
    state: EditorState.create({
      doc: text,
      extensions: [
        Prec.highest(keymap.of([{key: "Mod-Enter", run: () => (check(), true)}])),
        keymap.of([...defaultKeymap, ...historyKeymap, indentWithTab]),
        history(), indentOnInput(), bracketMatching(), indentUnit.of("    "),
        pythonLanguage, syntaxHighlighting(colours), look,
        EditorView.contentAttributes.of({"aria-label": label, "aria-describedby": help, tabindex: "0"}),
        EditorView.updateListener.of((update) => update.docChanged && changed(update.state.doc.toString())),
      ],
    }),
  });
  return {
    focus: () => view.focus(),
    text: () => view.state.doc.toString(),
    replace: (text) => view.dispatch({
      changes: {from: 0, to: view.state.doc.length, insert: text},
      annotations: isolateHistory.of("full"), // one step to undo
    }),
  };
};
