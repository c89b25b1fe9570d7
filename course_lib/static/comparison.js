// Replays a recorded session of comparisons: the slider says how many answers were given. No dependency, no request.
((figure) => {
  const data = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
  const slider = figure.querySelector("input"), button = figure.querySelector("button");
  const clips = [...figure.querySelectorAll(".clip")], plot = figure.querySelector("svg.curve");
  const steps = data.clips[0][0].length;
  const make = (parent, name, attributes, text) => {
    const node = parent.appendChild(document.createElementNS("http://www.w3.org/2000/svg", name));
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text !== undefined) node.textContent = text;
    return node;
  };
  const tip = (degrees, length) => {
    const angle = (degrees * Math.PI) / 180;
    return [100 - length * Math.sin(angle), 100 - length * Math.cos(angle)];
  };
  let timer = null;
  const shown = () => Math.max(Number(slider.value), 1) - 1;
  // The pendulum at one step; the line of where its bob goes shows the whole clip while nothing moves.
  const drawClips = (step) => clips.forEach((clip, side) => {
    const svg = clip.querySelector("svg"), angles = data.clips[shown()][side], [x, y] = tip(angles[step], 70);
    svg.replaceChildren();
    make(svg, "circle", {cx: 100, cy: 100, r: 94, class: "rim"});
    // the trail winds outwards, so that a second turn does not hide the first
    make(svg, "polyline", {class: "trace", points: angles.map((a, i) => tip(a, 76 + (16 * i) / steps).join(",")).join(" ")});
    make(svg, "line", {x1: 100, y1: 100, x2: x, y2: y, class: "rod"});
    make(svg, "circle", {cx: x, cy: y, r: 10, class: "bob"});
  });
  const drawCurve = (curve) => {
    const width = Math.max(plot.parentElement.clientWidth, 260), height = 200, [left, right, top, bottom] = [40, 20, 10, 38];
    const all = data.curves.flat(), high = Math.max(...all, 0.1) * 1.05, low = Math.min(...all, -0.1) * 1.05;
    const px = (v) => left + ((v + 180) / 360) * (width - left - right);
    const py = (v) => height - bottom - ((v - low) / (high - low)) * (height - top - bottom);
    plot.setAttribute("viewBox", `0 0 ${width} ${height}`);
    plot.setAttribute("height", height);
    plot.replaceChildren();
    for (let v = -180; v <= 180; v += 60) {
      make(plot, "line", {x1: px(v), x2: px(v), y1: top, y2: height - bottom, class: "grid"});
      make(plot, "text", {x: px(v), y: height - bottom + 15, "text-anchor": "middle"}, `${v}°`);
    }
    const step = [0.05, 0.1, 0.2, 0.5, 1, 2, 5].find((s) => (high - low) / s <= 6) || 10;
    for (let v = Math.ceil(low / step) * step; v <= high; v += step) {
      make(plot, "line", {x1: left, x2: width - right, y1: py(v), y2: py(v), class: Math.abs(v) < 1e-9 ? "zero" : "grid"});
      make(plot, "text", {x: left - 5, y: py(v) + 4, "text-anchor": "end"}, String(Number(v.toFixed(2))));
    }
    make(plot, "text", {x: (left + width - right) / 2, y: height - 4, "text-anchor": "middle"}, "angle from upright, positive to the left");
    make(plot, "polyline", {class: "learned", points: curve.map((v, i) => `${px(data.angles[i])},${py(v)}`).join(" ")});
    const best = data.angles[curve.indexOf(Math.max(...curve))];
    plot.setAttribute("aria-label", Math.max(...curve) - Math.min(...curve) < 1e-6
      ? "The learned reward is the same at every angle."
      : `The learned reward is largest at ${best} degrees from upright: ${Math.max(...curve).toFixed(2)}; smallest: ${Math.min(...curve).toFixed(2)}.`);
  };
  const draw = () => {
    const given = Number(slider.value), pair = shown(), curve = data.curves[given];
    slider.setAttribute("aria-valuetext", `${given} answers`);
    figure.querySelector("output").textContent = given;
    clips.forEach((clip, side) => {
      clip.classList.toggle("chosen", given > 0 && data.chosen[pair] === ["left", "right"][side]);
      clip.querySelector(".words").textContent = data.texts[pair][side];
      clip.querySelector("svg").setAttribute("aria-label", `${["Left", "Right"][side]} clip: ${data.texts[pair][side]}`);
    });
    figure.querySelector(".answer").textContent =
      (given ? `Answer ${given}: “${data.answers[pair]}”.` : "The first pair, before any answer.") +
      ` The reward now foresees ${Math.round(100 * data.accuracies[given])}% of 400 comparisons that nobody was asked about.`;
    drawClips(0);
    drawCurve(curve);
    figure.querySelectorAll("tbody td").forEach((cell, i) => { cell.textContent = curve[3 * i].toFixed(2); });
  };
  const stop = () => { if (timer !== null) cancelAnimationFrame(timer); timer = null; };
  const play = () => {
    stop();
    const start = performance.now();
    const frame = (now) => {
      const step = Math.min(Math.floor((now - start) / 75), steps - 1); // two thirds of the true speed
      drawClips(Math.max(step, 0));
      timer = step < steps - 1 ? requestAnimationFrame(frame) : null;
    };
    timer = requestAnimationFrame(frame);
  };
  slider.addEventListener("input", () => { stop(); draw(); });
  button.addEventListener("click", play);
  new ResizeObserver(() => drawCurve(data.curves[Number(slider.value)])).observe(figure);
  draw();
})(document.currentScript.closest("figure"));
