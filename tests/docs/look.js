// Opens each page of the site in a frame of each width, and sends what it finds to the server.
'use strict';

const MATH = 'http://www.w3.org/1998/Math/MathML';

function boxOf(element) {
  return element.getBoundingClientRect();
}

// The text that a reader sees, without code and formulas
function proseOf(body) {
  const copy = body.querySelector('article').cloneNode(true);
  copy.querySelectorAll('code, pre, math, script, style').forEach((part) => part.remove());
  return copy.textContent;
}

// What reaches beyond the right edge, if anything
function widestOf(root) {
  const parts = [...root.querySelectorAll('article *')].filter((e) => !e.closest('pre, table, math'));
  const wide = parts.filter((e) => boxOf(e).right > root.clientWidth + 1);
  return wide.map((e) => `${e.localName}: ${e.textContent.slice(0, 80)}`).slice(-3);
}

// Tables and blocks of code whose end is seen only after scrolling
function cutIn(root) {
  const parts = [...root.querySelectorAll('article pre > code, article .md-typeset__scrollwrap')];
  const cut = parts.filter((e) => e.scrollWidth > e.clientWidth + 1);
  return cut.map((e) => `${e.localName === 'code' ? 'code' : 'table'} ${e.scrollWidth} of `
    + `${e.clientWidth} px: ${e.textContent.trim().slice(0, 80)}`);
}

// The brackets next to matrices
function bracketsOf(page) {
  const operators = [...page.getElementsByTagNameNS(MATH, 'mo')];
  return operators.filter((o) => /^[()[\]{}|]$/.test(o.textContent.trim())
    && [o.previousElementSibling, o.nextElementSibling].some((e) => e?.localName === 'mtable'));
}

function faultsOfFormulas(page) {
  const faults = [];
  const all = (name) => [...page.getElementsByTagNameNS(MATH, name)];
  const fault = (element, what) => faults.push(`${what}: ${element.closest('math').textContent}`);
  for (const math of all('math')) {
    if (boxOf(math).height < 5 || boxOf(math).width < 3) fault(math, 'not drawn');
  }
  for (const fraction of all('mfrac')) {
    const [above, below] = [...fraction.children].map(boxOf);
    if (above.bottom > below.top + 1) fault(fraction, 'numerator not above denominator');
  }
  for (const power of all('msup')) {
    const [base, exponent] = [...power.children].map(boxOf);
    if (exponent.top >= base.top || exponent.left < base.right - 2) fault(power, 'power not above');
  }
  for (const index of all('msub')) {
    const [base, below] = [...index.children].map(boxOf);
    if (below.bottom <= base.bottom || below.left < base.right - 2) fault(index, 'index not below');
  }
  for (const accent of all('mover')) {
    const [base, dot] = [...accent.children].map(boxOf);
    if (dot.height < 1 || dot.top >= base.top) fault(accent, 'dot not above its letter');
  }
  for (const bracket of bracketsOf(page)) {
    const matrix = bracket.parentElement.querySelector(':scope > mtable');
    if (boxOf(bracket).height < 0.9 * boxOf(matrix).height) fault(bracket, 'bracket too low');
  }
  return faults;
}

function look(frame) {
  const page = frame.contentDocument;
  const root = page.documentElement;
  return {
    prose: proseOf(page.body),
    overflow: root.scrollWidth - root.clientWidth,
    widest: widestOf(root),
    cut: cutIn(root),
    images: [...page.images].filter((i) => !i.naturalWidth).map((i) => i.getAttribute('src')),
    n_formulas: page.getElementsByTagNameNS(MATH, 'math').length,
    n_brackets: bracketsOf(page).length,
    formulas: faultsOfFormulas(page),
    errors: frame.contentWindow.errors || [],
  };
}

async function open(path, width) {
  const frame = document.createElement('iframe');
  frame.style = `width: ${width}px; height: 900px; border: 0`;
  const loaded = new Promise((done) => { frame.onload = done; });
  frame.src = path;
  document.body.append(frame);
  await loaded;
  await frame.contentDocument.fonts.ready;
  for (const image of frame.contentDocument.images) {
    image.loading = 'eager';
    await image.decode().catch(() => {});
  }
  await new Promise((done) => setTimeout(done, 50)); // for scripts that run after the load
  const found = look(frame);
  frame.remove();
  return found;
}

async function main() {
  const { pages, widths } = await (await fetch('/pages.json')).json();
  const found = [];
  for (const path of pages) {
    for (const width of widths) {
      found.push({ path, width, ...await open(path, width) });
    }
  }
  await fetch('/found', { method: 'POST', body: JSON.stringify(found) });
}

main().catch((error) => fetch('/found', { method: 'POST', body: JSON.stringify(String(error)) }));
