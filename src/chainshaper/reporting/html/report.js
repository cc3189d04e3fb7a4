// Draw everything from the data that the page carries.

const report = JSON.parse(document.getElementById("data").textContent);
const place = (id) => {
  const host = document.getElementById(id);
  host.replaceChildren();
  return host;
};
const openCycle = plotTimeline(place("timeline"), report.recordings);
plotOverTime(place("over-time"), report.recordings, openCycle);
plotHistogram(place("histogram"), report.recordings);
plotDistribution(place("cdf"), report.recordings);
plotBreakdown(place("breakdown"), report.recordings);
report.plans.forEach((plan, number) => plotSlots(place(`slots-${number}`), plan));
document.documentElement.dataset.drawn = "yes";
