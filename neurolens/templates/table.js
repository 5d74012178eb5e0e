// Finds words as `neurolens find` does in rows with data-words, else anywhere in a row; accents do not matter.
// Sorts by a heading (numbers as numbers, what is missing last), and shows rows that hold all words and a chosen kind.
(() => {
  const table = document.querySelector('.survey table'), body = table.tBodies[0], rows = [...body.rows];
  const words = document.getElementById('words'), kinds = [...document.querySelectorAll('.kind')];
  const shown = document.getElementById('shown');
  const plain = t => t.normalize('NFKD').replace(/\p{M}/gu, '').toLowerCase();
  const texts = new Map(rows.map(r => [r, plain(r.textContent)]));
  const known = new Map(rows.map(r => [r, r.dataset.words?.split(' ')]));
  const has = (r, w) => known.get(r)?.some(k => /^\d/.test(w) ? [w, w + 'mm', 'f/' + w].includes(k) : k.startsWith(w))
    ?? texts.get(r).includes(w);
  const filter = () => {
    const all = plain(words.value).replace(/\b[ft]\/?(?=\d)/g, 'f/').split(/\s+|-(?!\d)/).filter(Boolean);
    const on = new Set(kinds.filter(k => k.checked).map(k => k.value));
    let count = 0;
    for (const r of rows) {
      const seen = r.dataset.kinds.split(' ').some(k => on.has(k)) && all.every(w => has(r, w));
      r.hidden = !seen; count += seen;
    }
    shown.textContent = count + ' of ' + rows.length;
  };
  const key = (r, i) => r.cells[i].dataset.v ?? r.cells[i].textContent;
  [...table.tHead.rows[0].cells].forEach((head, i) => head.addEventListener('click', () => {
    const down = head.getAttribute('aria-sort') === 'ascending', sign = down ? -1 : 1;
    for (const h of table.tHead.rows[0].cells) h.removeAttribute('aria-sort');
    head.setAttribute('aria-sort', down ? 'descending' : 'ascending');
    const numeric = head.dataset.kind === 'number';
    const of = new Map(rows.map(r => [r, key(r, i)]));
    rows.sort((a, b) => {
      const x = of.get(a), y = of.get(b);
      if (x === '' || y === '') return (x === '') - (y === '');
      return sign * (numeric ? x - y : x.localeCompare(y));
    });
    body.append(...rows);
  }));
  words.addEventListener('input', filter); kinds.forEach(k => k.addEventListener('change', filter)); filter();
})();
