"use strict";
(() => {
  const config = { responsive: true, displaylogo: false, plotlyServerURL: "", modeBarButtonsToRemove: ["sendChartToCloud", "select2d", "lasso2d", "autoScale2d"] };
  for (const place of document.querySelectorAll("[data-figure]")) {
    const data = document.getElementById("data-" + place.dataset.figure);
    const figure = JSON.parse(data.textContent);
    figure.layout.template = undefined;
    if (window.innerWidth < 600) {
      figure.layout.margin = { ...figure.layout.margin, l: 44, r: 6 };
      Object.assign(figure.layout.xaxis, { nticks: 3, tickangle: 0 }); // turned ones lie over the title
    }
    place.style.height = `${figure.layout.height}px`; // Plotly forgets its own when the window changes
    Plotly.newPlot(place, figure.data, figure.layout, config);
  }
  for (const button of document.querySelectorAll("[data-scale]")) {
    button.addEventListener("click", () => {
      const logarithmic = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", String(logarithmic));
      const change = logarithmic
        ? { "yaxis.type": "log", "yaxis.autorange": true }
        : { "yaxis.type": "linear", "yaxis.autorange": true };
      Plotly.relayout(button.dataset.scale, change);
    });
  }
  for (const button of document.querySelectorAll("[data-plot]")) {
    button.addEventListener("click", () => {
      const change = { "xaxis.autorange": false, "xaxis.range": [Number(button.dataset.from), Number(button.dataset.to)] };
      Plotly.relayout(button.dataset.plot, change);
      document.getElementById(button.dataset.plot).scrollIntoView({ behavior: "smooth", block: "center" });
    });
  }
  const two = (number) => String(Math.floor(number)).padStart(2, "0");
  const offset = (date) => {
    const minutes = -date.getTimezoneOffset();
    return "UTC" + (minutes < 0 ? "−" : "+") + two(Math.abs(minutes) / 60) + ":" + two(Math.abs(minutes) % 60);
  };
  let first = null;
  for (const time of document.querySelectorAll("time")) {
    const date = new Date(time.dateTime);
    if (Number.isNaN(date.valueOf())) continue;
    first = first || date;
    time.title = date.toLocaleString() + " (" + offset(date) + ") · " + time.dateTime;
  }
  if (first !== null) {
    document.getElementById("local-time").textContent = "; your clock shows " + offset(first) + ", point at a time to see it";
  }
  const resize = () => {
    for (const place of document.querySelectorAll(".js-plotly-plot")) Plotly.Plots.resize(place);
  };
  window.addEventListener("beforeprint", resize);
  window.addEventListener("afterprint", resize);
})();
