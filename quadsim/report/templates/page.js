"use strict";

// Plots: one colour scheme with the page, one time range for all, one switch per run.
const plots = [...document.querySelectorAll(".plot")];
const timed = plots.filter((plot) => "timed" in plot.dataset);
const dark = matchMedia("(prefers-color-scheme: dark)");
const narrow = matchMedia("(max-width: 40rem)").matches;
const config = { responsive: true, displaylogo: false, displayModeBar: narrow ? false : "hover",
  modeBarButtonsToRemove: ["select2d", "lasso2d", "sendChartToCloud"] };

function pageColours(layout) {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(name).trim();
  const patch = {
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    "font.color": colour("--text"),
    "hoverlabel.bgcolor": colour("--raised"),
    "hoverlabel.font.color": colour("--text"),
    "modebar.bgcolor": "rgba(0,0,0,0)",
    "modebar.color": colour("--quiet"),
    "modebar.activecolor": colour("--text"),
  };
  const axes = Object.keys(layout).filter((key) => /^[xy]axis/.test(key));
  if (layout.scene) axes.push("scene.xaxis", "scene.yaxis", "scene.zaxis");
  for (const axis of axes) {
    patch[`${axis}.gridcolor`] = colour("--line");
    patch[`${axis}.zerolinecolor`] = colour("--line");
    patch[`${axis}.linecolor`] = colour("--quiet");
  }
  return patch;
}

// Where there is no room for two columns, each panel is below the one before it.
function stackPanels(layout) {
  const names = Object.keys(layout).filter((key) => /^yaxis\d*$/.test(key));
  const panels = names.sort((a, b) => a.slice(5) - b.slice(5)).map((name) => [layout[`x${name.slice(1)}`], layout[name]]);
  if (panels.length < 2) return;
  const { t, b } = layout.margin;
  const heights = panels.map(([, y]) => (y.domain[1] - y.domain[0]) * (layout.height - t - b));
  const gap = 72;
  const total = heights.reduce((sum, height) => sum + gap + height);
  const isAbove = (title, x, y) => Math.abs(title.y - y.domain[1]) < 1e-6 && title.x > x.domain[0] && title.x < x.domain[1];
  const titles = panels.map(([x, y]) => layout.annotations?.find((title) => isAbove(title, x, y)));
  let top = total;
  panels.forEach(([x, y], i) => {
    x.domain = [0, 1];
    y.domain = [(top - heights[i]) / total, top / total];
    if (titles[i]) Object.assign(titles[i], { x: 0.5, y: top / total });
    top -= heights[i] + gap;
    if (x.title?.text === "time [s]" && x !== panels.at(-1)[0]) delete x.title;
  });
  layout.height = total + t + b;
}

let linking = false;

async function followTime(source, event) {
  if (linking || !Object.keys(event).some((key) => key.startsWith("xaxis"))) return;
  linking = true;
  const range = [...source.layout.xaxis.range];
  await Promise.all(timed.filter((plot) => plot !== source).map((plot) => Plotly.relayout(plot, { "xaxis.range": range })));
  linking = false;
}

function showRun(group, visible) {
  for (const plot of plots) {
    const traces = plot.data.flatMap((trace, i) => (trace.legendgroup === group ? [i] : []));
    if (traces.length) Plotly.restyle(plot, { visible }, traces);
  }
}

function hasWebGl() {
  return Boolean(document.createElement("canvas").getContext("webgl2"));
}

async function drawPlots() {
  for (const plot of plots) {
    const figure = JSON.parse(document.getElementById(`${plot.id}-figure`).textContent);
    if (figure.layout.scene && !hasWebGl()) {
      plot.style.height = "auto";
      plot.textContent = "This plot needs WebGL, which this browser does not offer.";
      plot.classList.add("quiet");
      plots.splice(plots.indexOf(plot), 1);
      continue;
    }
    if (narrow) stackPanels(figure.layout);
    if (narrow && figure.layout.scene) figure.layout.height = plot.clientWidth; // the camera sees a square
    plot.style.height = `${figure.layout.height}px`;
    await Plotly.newPlot(plot, figure.data, figure.layout, config);
    await Plotly.relayout(plot, pageColours(figure.layout));
  }
  for (const plot of timed) plot.on("plotly_relayout", (event) => followTime(plot, event));
  for (const box of document.querySelectorAll("[data-run]")) {
    box.addEventListener("change", () => showRun(box.dataset.run, box.checked));
  }
  dark.addEventListener("change", () => plots.forEach((plot) => Plotly.relayout(plot, pageColours(plot.layout))));
  document.documentElement.dataset.drawn = plots.length;
}

// Videos: one button plays all; the first leads, and one that drifts is set right.
const videos = [...document.querySelectorAll("video")];
const button = document.getElementById("play-all");

// Films of long flights run faster than those of short ones: simulated seconds per second of film.
const speedOf = (video) => (video.duration ? Number(video.dataset.length) / video.duration : 1);
const flownTime = (video) => video.currentTime * speedOf(video);

function playAll() {
  const playing = videos.some((video) => !video.paused);
  if (playing) return videos.forEach((video) => video.pause());
  const start = videos[0].ended ? 0 : flownTime(videos[0]);
  const fastest = Math.max(...videos.map(speedOf));
  videos.forEach((video) => {
    video.playbackRate = fastest / speedOf(video);
    video.currentTime = Math.min(start / speedOf(video), video.duration || start);
    video.play().catch(() => {}); // paused again before it had begun
  });
}

function followLeader() {
  const [leader, ...others] = videos;
  for (const video of others) {
    const drift = flownTime(video) - flownTime(leader);
    if (!video.ended && Math.abs(drift) > 0.15 * speedOf(leader)) video.currentTime = flownTime(leader) / speedOf(video);
  }
}

if (button) {
  button.addEventListener("click", playAll);
  videos[0].addEventListener("timeupdate", followLeader);
  for (const video of videos) {
    for (const event of ["play", "pause"]) {
      video.addEventListener(event, () => {
        button.textContent = videos.some((each) => !each.paused) ? "Pause all" : "Play all together";
      });
    }
  }
}

drawPlots();
