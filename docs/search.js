// Ranking and excerpts of the search, from the texts of all pages in pages.js: they are there
// offline, too, where a browser fetches no page.

// what readers look for first, in the units of a word found in a text (5)
const PLACES = { guide: 3, tutorials: 2, reference: 2, api: -2, validation: -4, changelog: -6 };

const wordsOf = (query) =>
  query.toLowerCase().split(/[^\p{Letter}\p{Number}_]+/u).filter((word) => word);

// Robertson & Zaragoza 2009, BM25: more occurrences count less and less, in long pages less
function frequency(text, word, usualLength) {
  const count = text.toLowerCase().split(word).length - 1;
  return (6 * count) / (count + 1.2 * (0.25 + (0.75 * text.length) / usualLength));
}

function rank(score, page, words, texts) {
  const lengths = Object.values(texts).map((text) => text.length);
  const usual = lengths.reduce((a, b) => a + b, 0) / lengths.length;
  const found = words.map((word) => frequency(texts[page] || "", word, usual));
  return score + (PLACES[page.split("/")[0]] || 0) + found.reduce((a, b) => a + b, 0);
}

// about 240 letters with as many different words as there are, in pieces: [text, is a word]
function excerpt(text, words) {
  const low = text.toLowerCase();
  let start = 0, most = -1;
  for (const word of words)
    for (let at = low.indexOf(word); at >= 0; at = low.indexOf(word, at + 1)) {
      const near = words.filter((one) => low.slice(Math.max(at - 80, 0), at + 160).includes(one));
      if (near.length > most) [start, most] = [Math.max(at - 80, 0), near.length];
    }
  if (start) start = text.indexOf(" ", start) + 1;
  const end = text.length > start + 240 ? text.lastIndexOf(" ", start + 240) : text.length;
  const shown = (start ? "… " : "") + text.slice(start, end) + (end < text.length ? " …" : "");
  if (!words.length) return [[shown, false]];
  const pieces = shown.split(new RegExp(`(${words.join("|")})`, "iu"));
  return pieces.map((piece, k) => [piece, k % 2 === 1]).filter(([piece]) => piece);
}

if (typeof document === "undefined") module.exports = { wordsOf, rank, excerpt };
else {
  const words = wordsOf(new URLSearchParams(window.location.search).get("q") || "");
  // the other numbers are Sphinx's own
  window.Scorer = {
    score: ([page, , , , score]) => rank(score, page, words, PAGE_TEXTS),
    objNameMatch: 11, objPartialMatch: 6, objPrio: { 0: 15, 1: 5, 2: -5 }, objPrioDefault: 0,
    title: 15, partialTitle: 7, term: 5, partialTerm: 2,
  };
  const add = (item) => {
    const link = item.querySelector("a");
    const page = link && link.getAttribute("href").replace(/\.html.*$/, "");
    if (!page || !PAGE_TEXTS[page] || item.querySelector(".context")) return;
    const line = document.createElement("p");
    line.className = "context";
    for (const [piece, marked] of excerpt(PAGE_TEXTS[page], words)) {
      const part = document.createElement(marked ? "mark" : "span");
      part.textContent = piece;
      line.appendChild(part);
    }
    item.appendChild(line);
  };
  document.addEventListener("DOMContentLoaded", () => {
    const results = document.getElementById("search-results");
    new MutationObserver(() => results.querySelectorAll("li").forEach(add)).observe(results, {
      childList: true, subtree: true,
    });
  });
}
