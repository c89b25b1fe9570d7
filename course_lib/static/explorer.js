// Draws the precomputed series of one explorer and redraws when a slider or the width changes. No dependency, no request.
// A page may set `figure.explorer.mine`: of the sliders' positions, values of the same series to draw over
// them, null for those to leave alone; or null.
((figure) => {
  const data = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
  const sliders = [...figure.querySelectorAll("input[type=range]")];
  const svgs = [...figure.querySelectorAll("svg")];
  const short = (v) => (v === null ? "none" : String(Number(v.toPrecision(3))));
  const make = (parent, name, attributes, text) => {
    const node = parent.appendChild(document.createElementNS("http://www.w3.org/2000/svg", name));
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text !== undefined) node.textContent = text;
    return node;
  };
  const ticks = (low, high, count) => {
    const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
    const marks = [];
    for (let v = Math.ceil(low / step) * step; v <= high + step * 1e-6; v += step) marks.push(Number(v.toFixed(9)));
    return marks;
  };
  const drawPanel = (svg, panel, values, mine) => {
    const width = Math.max(svg.parentElement.clientWidth, 260), height = 210;
    const [left, right, top, bottom] = [46, 8, 10, 40];
    const reached = (mine ?? []).flatMap((one, i) => (one && panel.series.includes(i) ? one.filter((v) => v !== null) : []));
    const range = [Math.min(panel.y[0], ...reached), Math.max(panel.y[1], ...reached)];
    const margin = (range[1] - range[0]) / 20;
    if (range[0] < panel.y[0]) range[0] -= margin;
    if (range[1] > panel.y[1]) range[1] += margin;
    const x = (v) => left + ((v - panel.x[0]) / (panel.x[1] - panel.x[0])) * (width - left - right);
    const y = (v) => height - bottom - ((v - range[0]) / (range[1] - range[0])) * (height - top - bottom);
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.setAttribute("height", height);
    svg.replaceChildren();
    for (const v of ticks(...range, 4)) {
      make(svg, "line", {x1: left, x2: width - right, y1: y(v), y2: y(v), class: v === 0 ? "zero" : "grid"});
      make(svg, "text", {x: left - 5, y: y(v) + 4, "text-anchor": "end"}, short(v));
    }
    for (const v of ticks(...panel.x, width < 420 ? 5 : 10))
      make(svg, "text", {x: x(v), y: height - bottom + 16, "text-anchor": "middle"}, short(v));
    make(svg, "text", {x: (left + width - right) / 2, y: height - 6, "text-anchor": "middle"}, data.xLabel);
    const paintSeries = (index, values, whose) => {
      const series = data.series[index];
      const points = series.x.map((v, i) => [v, values[index][i]]).filter((p) => p[1] !== null);
      const paint = {class: `${series.kind} c${index % 5} ${whose}`};
      if (series.kind === "line")
        make(svg, "polyline", {...paint, points: points.map((p) => `${x(p[0])},${y(p[1])}`).join(" ")});
      const bar = Math.max(2, (0.6 * (width - left - right)) / (series.x.length + 1));
      for (const [px, py] of points) {
        if (series.kind === "bar")
          make(svg, "rect", {...paint, x: x(px) - bar / 2, width: bar, y: Math.min(y(py), y(0)), height: Math.abs(y(py) - y(0))});
        else if (series.kind === "points" || !whose)
          make(svg, "circle", {class: `points c${index % 5} ${whose}`, cx: x(px), cy: y(py), r: series.kind === "line" ? 2.5 : 4});
      }
    };
    const own = panel.series.filter((index) => mine?.[index]);
    panel.series.forEach((index) => paintSeries(index, values, own.includes(index) ? "book" : ""));
    own.forEach((index) => paintSeries(index, mine, "mine"));
    const told = (index, values, name) => {
      const kept = values[index].filter((v) => v !== null);
      return `${data.series[index].name}${name}: from ${short(Math.min(...kept))} to ${short(Math.max(...kept))}`;
    };
    const all = [...panel.series.map((index) => told(index, values, "")), ...own.map((index) => told(index, mine, ", yours"))];
    svg.setAttribute("aria-label", panel.label + ". " + all.join("; "));
  };
  const body = figure.querySelector("tbody"), rows = [...body.rows];
  const fill = (row, values) => row.querySelectorAll("td").forEach((cell, j) => {
    if (j < values.length) cell.textContent = values[j] === null ? "" : short(values[j]);
  });
  const draw = () => {
    let combination = 0;
    sliders.forEach((slider, i) => {
      const choices = data.sliders[i].values, chosen = choices[slider.value];
      combination = combination * choices.length + Number(slider.value);
      slider.setAttribute("aria-valuetext", chosen);
      slider.parentElement.querySelector("output").textContent = chosen;
    });
    const values = data.values[combination];
    const mine = figure.explorer.mine?.(sliders.map((slider) => Number(slider.value))) ?? null;
    svgs.forEach((svg, i) => drawPanel(svg, data.panels[i], values, mine));
    body.querySelectorAll(".mine").forEach((row) => row.remove());
    rows.forEach((row, i) => {
      fill(row, values[i]);
      if (!mine?.[i]) return;
      const own = row.cloneNode(true);
      row.after(own);
      own.className = "mine";
      own.querySelector("th").textContent += ", yours";
      fill(own, mine[i]);
    });
  };
  figure.explorer = {data, draw};
  sliders.forEach((slider) => slider.addEventListener("input", draw));
  new ResizeObserver(draw).observe(figure);
  draw();
})(document.currentScript.closest("figure"));
