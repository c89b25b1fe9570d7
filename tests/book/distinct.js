// Marks one text of each kind, the longest, and returns how many kinds there are. Texts are of one kind if they share what decides
// how they meet their background: colours, size, shadows, and whatever paints, clips or moves them or lies over or under them.
// The mark is an attribute that axe leaves out of the names that it gives to elements. window.alike keeps the texts of each kind.
(mark) => {
  const clear = /^rgba\(.*, 0\)$|^transparent$/;
  const box = (rect) => ({left: rect.left, top: rect.top, right: rect.right, bottom: rect.bottom});
  const holds = (a, b) => a.left <= b.left + 1 && a.top <= b.top + 1 && a.right >= b.right - 1 && a.bottom >= b.bottom - 1;
  const meets = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  const replaced = new Set(["IMG", "SVG", "CANVAS", "VIDEO", "OBJECT", "IFRAME", "INPUT", "SELECT", "TEXTAREA"]);
  const own = (node) => [...node.childNodes].filter((one) => one.nodeType === 3 && one.nodeValue.trim());

  // What an element does to the text in it, or near it; "" for most.
  const paint = (style) => [
    clear.test(style.backgroundColor) ? "" : style.backgroundColor + style.backgroundClip,
    style.backgroundImage === "none" ? "" : style.backgroundImage,
  ].join("");
  const effect = (node, style) => [
    paint(style),
    replaced.has(node.nodeName.toUpperCase()) ? node.nodeName : "",
    style.opacity === "1" ? "" : `opacity ${style.opacity}`,
    style.visibility === "visible" ? "" : style.visibility,
    style.filter === "none" ? "" : style.filter,
    style.mixBlendMode === "normal" ? "" : style.mixBlendMode,
    style.overflow === "visible" ? "" : `overflow ${style.overflow}`,
    style.clip === "auto" ? "" : style.clip,
    style.clipPath === "none" ? "" : style.clipPath,
    style.position === "static" ? "" : `${style.position} ${style.zIndex}`,
    style.textIndent === "0px" ? "" : style.textIndent,
    ...["::before", "::after"].map((which) => {
      const pseudo = getComputedStyle(node, which);
      const painted = ["none", "normal"].includes(pseudo.content) ? "" : paint(pseudo);
      return painted && `${which} ${painted} ${pseudo.position} ${pseudo.width} ${pseudo.height}`;
    }),
    ...["inert", "disabled", "aria-disabled"].map((name) => (node.hasAttribute(name) ? name : "")),
  ].filter(Boolean).join("; ");

  const all = [...document.querySelectorAll("*")];
  if (all.some((node) => node.shadowRoot)) throw new Error("a page with a shadow root: its colours would not be looked at");
  const place = new Map(all.map((node, at) => [node, at]));
  const effects = new Map(), boxes = new Map(), above = new Map();
  for (const node of all) {
    const effective = effect(node, getComputedStyle(node));
    above.set(node, [...(above.get(node.parentElement) ?? []), ...(effective ? [node] : [])]);
    if (effective) {
      effects.set(node, effective);
      boxes.set(node, box(node.getBoundingClientRect()));
    }
  }
  const band = 64, bands = new Map(); // painters by the stripes of the page that they touch
  const stripes = (rect) => {
    const stripe = [];
    for (let at = Math.floor(rect.top / band); at <= Math.floor(rect.bottom / band); at++) stripe.push(at);
    return stripe;
  };
  for (const [node, rect] of boxes)
    if (rect.right > rect.left && rect.bottom > rect.top)
      for (const at of stripes(rect)) bands.set(at, [...(bands.get(at) ?? []), node]);

  window.alike = new Map();
  const longest = new Map();
  const range = document.createRange();
  for (const node of all) {
    const control = ["INPUT", "SELECT", "TEXTAREA"].includes(node.nodeName), texts = own(node);
    if (!control && !texts.length) continue;
    const rects = texts.flatMap((one) => { range.selectNodeContents(one); return [...range.getClientRects()]; });
    const text = rects.length ? {
      left: Math.min(...rects.map((rect) => rect.left)), top: Math.min(...rects.map((rect) => rect.top)),
      right: Math.max(...rects.map((rect) => rect.right)), bottom: Math.max(...rects.map((rect) => rect.bottom)),
    } : box(node.getBoundingClientRect());
    const style = getComputedStyle(node), ancestors = above.get(node), family = new Set(ancestors);
    const inside = ancestors.map((one) =>
      `${effects.get(one)} ${holds(boxes.get(one), text) ? "around" : meets(boxes.get(one), text) ? "across" : "apart"}`);
    const beside = new Set();
    for (const at of stripes(text))
      for (const one of bands.get(at) ?? [])
        if (!family.has(one) && meets(boxes.get(one), text)) beside.add(`${effects.get(one)} ${place.get(one) < place.get(node)}`);
    const words = texts.map((one) => one.nodeValue.trim()).join(" ");
    const kind = JSON.stringify([
      style.color, style.webkitTextFillColor, style.webkitTextStroke, style.fontSize, style.fontWeight, style.textShadow,
      words.length === 1, /[a-z0-9]/i.test(words), node.checkVisibility({visibilityProperty: true}),
      text.left + scrollX < 0 || text.top + scrollY < 0, inside, [...beside].sort(),
      control || node.closest("label, button, fieldset[disabled], [aria-labelledby]") ? place.get(node) : "",
    ]);
    const same = window.alike.get(kind) ?? window.alike.set(kind, []).get(kind);
    same.push(node);
    if (words.length > (longest.get(kind) ?? -1)) { // it comes first
      longest.set(kind, words.length);
      [same[0], same[same.length - 1]] = [node, same[0]];
    }
  }
  for (const [first] of window.alike.values()) first.setAttribute("xmlns", mark);
  return window.alike.size;
}
