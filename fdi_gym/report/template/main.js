// The page is put together, and drawn again where its width changes.
at("description").textContent = data.suite.description;
at("facts").textContent = `${data.suite.env}, process ${data.suite.process}, ${data.suite.flights} flights with ${data.suite.decisions} decisions, ` +
  `version ${data.suite.version}; ${data.methods.length} methods. Intervals are 95 %.`;
at("made").textContent = `fdi-gym report ${data.suite.name}. The tables and curves are those of the rows and their outcomes; the flights to look at were flown again.`;
methodsTable();
confusion();
const redraw = [comparison(), curves(), flight()];
let width = document.body.clientWidth, waiting = 0;
window.addEventListener("resize", () => {
  clearTimeout(waiting);
  waiting = setTimeout(() => {
    if (document.body.clientWidth === width) return;
    width = document.body.clientWidth;
    for (const draw of redraw) draw();
  }, 150);
});
