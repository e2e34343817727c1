// Puts the page together; where its data says that the run goes on, the server's events (live_page) let it grow.
function restyle() { readColours(); colourMap(); for (const chart of charts) chart(); draw(); }
readColours();
onTime.push(draw);
listenToMap();
function begin(first) { // all of `data` is new; what was chosen by hand stays
  const atEnd = first || now >= duration;
  ({ track, beacons, duration } = data);
  $("time").max = duration;
  showMap();
  if (first || !(touched || $("follow").checked)) fit();
  setTime(atEnd ? duration : now);
  for (const chart of charts) chart();
}
function connect() {
  const source = new EventSource("events");
  const on = (name, take) => source.addEventListener(name, (event) => take(JSON.parse(event.data)));
  const grow = (change) => { // the time shown stays where it was put, or at the end
    const following = now >= duration;
    change();
    $("time").max = duration;
    setTime(following && !playing ? duration : now);
  };
  const told = (text, on) => { $("link").textContent = text; $("link").className = on ? "sub push on" : "sub push off"; };
  $("link").hidden = $("live").hidden = false;
  told("connecting", false);
  source.onopen = () => told("connected", true);
  source.onerror = () => told("connection lost, trying again", false);
  on("begin", (all) => { Object.assign(data, all); begin(false); });
  on("step", (step) => grow(() => {
    const end = track.t.length - 1;
    if (end < 0 || step.pose.t > track.t[end]) for (const name in step.pose) track[name].push(step.pose[name]);
    duration = Math.max(step.pose.t, 1e-3);
    Object.assign(data, { scan: step.scan, links: step.links });
    beacons = step.beacons;
  }));
  on("map", (seen) => {
    Object.assign(data, seen);
    showMap();
    if (!touched && !$("follow").checked) fit();
  });
  on("words", (words) => { for (const id in words) if ($(id).innerHTML !== words[id]) $(id).innerHTML = words[id]; });
  on("end", () => { source.close(); told("the run has ended", false); });
  $("live").onclick = () => { stop(); setTime(duration); };
}
begin(true);
if (data.live) connect();
let width = window.innerWidth;
window.addEventListener("resize", () => {
  if (window.innerWidth !== width) { width = window.innerWidth; fit(); for (const chart of charts) chart(); } else draw();
});
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", restyle);
