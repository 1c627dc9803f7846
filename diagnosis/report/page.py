"""Style sheet and script of report.html. Both are inlined: the page fetches nothing."""

STYLE = """
:root{--ink:#1d2733;--soft:#5b6875;--paper:#fff;--card:#f5f7f9;--rule:#dde3e8;--part:#c3ccd5;--edge:#5b6875;
--measured:#1d2733;--nominal:#c8500a;--corrected:#0a66b0;--noise:#8a949e;--bad:#d21f3c}
@media (prefers-color-scheme:dark){:root{--ink:#e7ecf1;--soft:#9aa7b4;--paper:#12171d;--card:#1b222a;--rule:#323c46;
--part:#46525e;--edge:#a9b5c1;--measured:#e7ecf1;--nominal:#f28a45;--corrected:#58b0f5;--noise:#77828d;--bad:#ff5c74}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);
font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;
-webkit-text-size-adjust:100%;overflow-wrap:anywhere}
main{max-width:1040px;margin:0 auto;padding:20px 16px 60px}
h1{font-size:1.7rem;line-height:1.2;margin:.2em 0 .5em;letter-spacing:-.01em}
h1.match{color:var(--corrected)}
h2{font-size:1.15rem;margin:2.4em 0 .7em;padding-top:.9em;border-top:1px solid var(--rule)}
h3{font-size:1rem;line-height:1.35;margin:0 0 .4em}
h3.trace{margin:1.2em 0 .2em}
h3 small{font-weight:400;color:var(--soft)}
.kicker{margin:0;color:var(--soft);font-size:.9rem}
.note,.facts{color:var(--soft);font-size:.86rem;margin:.3em 0 .8em}
.verdict{font-size:1.1rem;padding-left:1.3em;margin:.4em 0 .9em}
.verdict li{margin:.25em 0}
.steps{display:flex;flex-wrap:wrap;gap:10px;margin:1em 0 .2em}
.steps div{flex:1 1 90px;background:var(--card);border-radius:10px;padding:10px 14px;border-left:5px solid var(--noise)}
.steps .nominal{border-color:var(--nominal)}.steps .corrected{border-color:var(--corrected)}
.steps small{font-size:.85rem;font-weight:400;white-space:nowrap}
.steps b{display:block;font-size:1.5rem;line-height:1.2}
.steps span{color:var(--soft);font-size:.82rem}
.pair{display:grid;grid-template-columns:minmax(0,1fr);gap:16px}
@media (min-width:760px){.pair{grid-template-columns:repeat(2,minmax(0,1fr))}h1{font-size:2.1rem}}
.card{background:var(--card);border-radius:12px;padding:16px;margin:0 0 16px}
.card .chart{max-width:560px}
.or{margin:.8em 0 .2em}
ul,ol{margin-top:.3em}
.scroll{overflow-x:auto;-webkit-overflow-scrolling:touch}
.wide svg{min-width:680px}
svg{display:block;width:100%;height:auto}
svg text{font-family:inherit;fill:var(--ink)}
.tick{font-size:10.5px;fill:var(--soft)}
.axis{font-size:11.5px}
.grid{stroke:var(--rule);stroke-width:1;fill:none}
.line{fill:none;stroke-width:1.7;stroke-linejoin:round}
.wide .line{stroke-width:1.5}.wide .measured.line{stroke-width:4;opacity:.3;stroke-linecap:round}
.measured{stroke:var(--measured)}.nominal{stroke:var(--nominal)}.corrected{stroke:var(--corrected)}
.noise{stroke:var(--noise);stroke-dasharray:5 4}
.band{fill:var(--corrected);fill-opacity:.15;stroke:none}
.dots{fill:none;stroke-width:3;stroke-linecap:round;opacity:.22}
.whisker{width:220px;height:34px}
.tickmark{stroke-width:3}.whisk{stroke-width:3;stroke-linecap:round}.point{fill:var(--corrected)}
.legend{display:flex;flex-wrap:wrap;gap:4px 18px;margin:.3em 0;font-size:.86rem}
.legend i{display:inline-block;width:22px;height:0;border-top:3px solid;vertical-align:middle;margin-right:6px}
.legend .measured{border-color:var(--measured)}.legend .nominal{border-color:var(--nominal)}
.legend .corrected{border-color:var(--corrected)}.legend .noise{border-color:var(--noise);border-top-style:dashed}
table{border-collapse:collapse;width:100%;font-size:.9rem}
th,td{text-align:left;padding:5px 12px 5px 0;border-bottom:1px solid var(--rule);vertical-align:middle;white-space:nowrap}
th{color:var(--soft);font-weight:500}
td small{display:block;color:var(--soft);font-weight:400}
.chosen td:first-child{font-weight:700;box-shadow:inset 4px 0 var(--bad);padding-left:10px}
.bar{display:inline-block;width:90px;height:9px;background:var(--rule);border-radius:5px;overflow:hidden;margin-right:6px}
.bar i{display:block;height:100%;background:var(--corrected)}
.part{fill:var(--part);stroke:var(--edge);stroke-width:1.2;stroke-linejoin:round}
.part.bad{fill:var(--bad);fill-opacity:.75;stroke:var(--bad)}
.ghost{opacity:.16}
.link{stroke:var(--edge);stroke-width:2}
.hinge{fill:var(--paper);stroke:var(--edge);stroke-width:1.6}
.slide{fill:none;stroke:var(--edge);stroke-width:1.6}
.ground{stroke:var(--edge);stroke-width:2}.ground.bad{stroke:var(--bad);stroke-width:4}
.sheet{fill:var(--rule);fill-opacity:.6;stroke:none}.sheet.bad{fill:var(--bad);fill-opacity:.3;stroke:var(--bad)}
.badmark{fill:none;stroke:var(--bad);stroke-width:3}
.leader{stroke:var(--bad);stroke-width:1.2;fill:none}
svg .badlabel{fill:var(--bad);font-size:12px;font-weight:600;paint-order:stroke;stroke:var(--paper);stroke-width:3px}
.mechanism,.animation svg{background:var(--card);border-radius:12px}
figure{margin:0}
.layer{stroke-width:1.6;fill-opacity:.16;stroke-linejoin:round}
.layer.measured{fill:var(--measured)}.layer.nominal{fill:var(--nominal)}.layer.corrected{fill:var(--corrected)}
.controls{display:flex;gap:10px;margin:8px 0}
.controls input{flex:1;min-width:0;accent-color:var(--corrected)}
.controls button{font:inherit;font-size:.86rem;min-width:70px;padding:4px 10px;border:1px solid var(--rule);border-radius:8px;
background:var(--card);color:var(--ink)}
@media (max-width:559px){.estimates tr{display:grid;grid-template-columns:1fr auto;border-bottom:1px solid var(--rule)}
.estimates :is(th,td){border:0;padding-bottom:2px}.estimates :is(th,td):nth-child(n+3){grid-column:1/-1}
.estimates td:nth-child(3)::before{content:"nominal "}
.estimates th:nth-child(n+3){display:none}.steps b{font-size:1.25rem}.steps div{padding:8px 10px}.bar{width:56px}}
details summary{cursor:pointer;margin:1em 0 .3em}
"""

SCRIPT = """
for (const figure of document.querySelectorAll("figure.animation")) {
  const paths = JSON.parse(figure.querySelector("script").textContent);
  const button = figure.querySelector("button"), slider = figure.querySelector("input");
  const frames = Number(slider.max) + 1, pause = 0.8, seconds = Number(figure.dataset.seconds);
  let playing = !matchMedia("(prefers-reduced-motion: reduce)").matches, from = performance.now();
  const show = k => {
    for (const look in paths) figure.querySelector(".layer." + look).setAttribute("d", paths[look][k]);
    slider.value = k;
  };
  const name = () => { button.textContent = playing ? "pause" : "play"; };
  const step = now => {
    if (!playing) return;
    const t = Math.max(0, now - from) / 1000 % (seconds + pause);
    show(Math.min(frames - 1, Math.floor(t / seconds * frames)));
    requestAnimationFrame(step);
  };
  const play = () => { from = performance.now() - slider.value / frames * seconds * 1000; requestAnimationFrame(step); };
  button.onclick = () => { playing = !playing; name(); if (playing) play(); };
  slider.oninput = () => { playing = false; name(); show(Number(slider.value)); };
  name(); show(0);
  if (playing) play();
}
"""
