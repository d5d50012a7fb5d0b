# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The frame of the page. Its policy lets a browser load nothing from anywhere, whatever the page says."""

from __future__ import annotations

from string import Template

# The scripts are those of the 3D scene, which unpacks itself: hence eval, WebAssembly and blobs. A frame without a source
# of its own has the policy of the page round it.
_POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; font-src data:; connect-src data: blob:; "
    "script-src 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; worker-src blob: data:; "
    "base-uri 'none'; form-action 'none'"
)

_STYLE = """
:root { color-scheme: light dark; --text: #1d2330; --soft: #566073; --back: #f6f7f9; --card: #fff; --line: #d9dee6;
  --link: #1a5fb4; --error: #b3261e; --warning: #8a5a00; --good: #2f6b3a; }
@media (prefers-color-scheme: dark) { :root { --text: #e6e9ef; --soft: #a3adbd; --back: #14171c; --card: #1d2128;
  --line: #353c47; --link: #8ab4f8; --error: #ff8a80; --warning: #ffc766; --good: #8fd19e; } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; scroll-behavior: smooth; }
body { margin: 0; background: var(--back); color: var(--text); font: 16px/1.5 system-ui, sans-serif; }
header, nav, main, footer { max-width: 1120px; margin: 0 auto; padding: 0 20px; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 28px 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 0 0 10px; }
p { margin: 0 0 12px; max-width: 75ch; overflow-wrap: anywhere; }
.note, figcaption, caption, header p, footer { color: var(--soft); font-size: .875rem; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(140px, 1fr)); gap: 10px; margin: 16px 0; }
.facts div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 8px 12px; }
dt { color: var(--soft); font-size: .8rem; }
dd { margin: 0; font-size: 1.15rem; font-weight: 600; font-variant-numeric: tabular-nums; }
nav { display: flex; flex-wrap: wrap; gap: 4px 18px; padding-bottom: 12px; }
a { color: var(--link); padding: 4px 0; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 16px 18px; margin: 0 0 16px; }
.grid { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 310px), 1fr)); gap: 2px 14px;
  align-items: start; }
figure { margin: 0 0 12px; min-width: 0; max-width: 620px; }
img { display: block; width: 100%; height: auto; background: #fff; border: 1px solid var(--line); border-radius: 6px; }
figcaption { margin-top: 6px; }
iframe { display: block; width: 100%; aspect-ratio: 8 / 5; background: #fff; border: 1px solid var(--line);
  border-radius: 6px; margin-bottom: 8px; }
.bar { display: flex; flex-wrap: wrap; align-items: center; gap: 2px 8px; font-size: .8125rem; color: var(--soft);
  margin: 6px 0; font-variant-numeric: tabular-nums; }
.bar i { flex: 0 1 180px; min-width: 80px; height: 10px; border-radius: 5px; }
.key { gap: 4px 16px; } .key i { display: inline-block; min-width: 12px; width: 12px; height: 12px; border-radius: 3px; }
.wide { overflow-x: auto; margin: 0 0 14px; }
table { border-collapse: collapse; font-size: .9375rem; }
caption { text-align: left; padding-bottom: 4px; }
th, td { text-align: left; padding: 4px 18px 4px 0; border-bottom: 1px solid var(--line); vertical-align: top;
  font-variant-numeric: tabular-nums; }
tbody th { font-weight: 500; }
thead th { color: var(--soft); font-size: .8125rem; font-weight: 600; }
.items { list-style: none; margin: 0 0 12px; padding: 0; }
.items li { padding: 6px 0; border-bottom: 1px solid var(--line); overflow-wrap: anywhere; }
.mark { font-size: .75rem; font-weight: 700; border: 1px solid; border-radius: 4px; padding: 1px 6px; color: var(--soft); }
.mark.error { color: var(--error); } .mark.warning { color: var(--warning); } .mark.good { color: var(--good); }
summary { cursor: pointer; padding: 6px 0; }
pre { overflow: auto; max-height: 70vh; margin: 0 0 12px; padding: 12px; border: 1px solid var(--line); border-radius: 6px;
  background: var(--back); font: .8125rem/1.45 ui-monospace, monospace; }
footer { padding-bottom: 28px; }
@media (max-width: 600px) { header, nav, main, footer { padding: 0 12px; } section { padding: 12px; }
  iframe { width: calc(100% - 24px); margin-left: 12px; } th, td { padding-right: 12px; } }
@media print { iframe, nav { display: none; } section { break-inside: avoid; } }
"""

TEMPLATE = Template(f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="referrer" content="no-referrer">
<title>$title</title>
<style>{_STYLE}</style>
</head>
<body>
<header><h1>$title</h1><p>$subtitle</p><dl class="facts">$facts</dl></header>
<nav aria-label="Sections">$links</nav>
<main>
$sections</main>
<footer>This file holds all that it shows: it loads nothing from elsewhere.</footer>
</body>
</html>
""")
"""To be filled with title, subtitle, facts, links and sections, as HTML."""
