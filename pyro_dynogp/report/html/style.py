"""Style sheet of the page: dark on white, colours of Okabe and Ito darkened for text, for print."""

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 1.5rem; background: #fff; color: #1a1a1a;
  overflow-wrap: anywhere;
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: .2rem 0 .6rem; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; margin: 2.2rem 0 .6rem; border-bottom: 2px solid #0072b2; }
h3 { font-size: 1.1rem; margin: 1.4rem 0 .4rem; }
p { max-width: 46rem; margin: .5rem 0; overflow-wrap: anywhere; }
.kicker { color: #00588a; font-weight: 600; margin: 0; }
.lead { font-size: 1.1rem; }
article { border-left: 4px solid #0072b2; padding-left: 1rem; margin: 1.2rem 0 2rem; }
aside { border: 2px solid #9a5b00; background: #fff8e8; padding: .6rem 1rem; margin: 1rem 0;
  overflow-wrap: anywhere; }
aside h2 { border: 0; margin: 0; font-size: 1.1rem; }
figure { margin: 1rem 0; }
figure img, figure svg { display: block; max-width: 100%; height: auto; }
article img { width: 36rem; }
figcaption { color: #444; font-size: .9rem; max-width: 46rem; overflow-wrap: anywhere; }
.wide { overflow-x: auto; margin: .8rem 0 1.2rem; background:
  linear-gradient(to right, #fff 40%, transparent) left / 2.5rem 100% no-repeat local,
  linear-gradient(to left, #fff 40%, transparent) right / 2.5rem 100% no-repeat local,
  linear-gradient(to right, #0003, transparent) left / .8rem 100% no-repeat scroll,
  linear-gradient(to left, #0003, transparent) right / .8rem 100% no-repeat scroll; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { text-align: left; vertical-align: top; padding: .35rem .6rem; overflow-wrap: anywhere;
  border-bottom: 1px solid #c8c8c8; }
thead th { border-bottom: 2px solid #555; vertical-align: bottom; white-space: normal; }
td:not(.n), thead th:not(.n) { min-width: 7rem; }
tbody th { font-weight: 400; min-width: 9rem; }
.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.better { color: #00543b; font-weight: 600; }
td.worse { color: #8f2f00; font-weight: 600; }
dl { margin: .6rem 0; }
dl > div { display: flex; gap: 1rem; padding: .15rem 0; break-inside: avoid; }
dt { flex: 0 0 19rem; color: #444; overflow-wrap: anywhere; }
dd { margin: 0; flex: 1; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.terms dt { flex-basis: 11rem; }
@media (max-width: 40rem) { dl > div { display: block; } dd { margin-left: 1rem; } }
@page { margin: 16mm 14mm; }
@media print {
  body { max-width: none; padding: 0; font-size: 10.5pt; }
  figure, aside, tr, h2, h3 { break-inside: avoid; }
  h2, h3, caption { break-after: avoid; }
  .wide { overflow: visible; background: none; }
  table { font-size: 9pt; }
  figure img { width: auto; max-height: 215mm; }
  article img { width: 130mm; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""
