'use strict';
// The search in the graph of an application that is folded by namespace: what matches stands out,
// its namespaces too, and those that have a match are opened.
for (const graph of document.querySelectorAll('.folded')) {
  const field = graph.querySelector('input'), number = graph.querySelector('output');
  const folds = [...graph.querySelectorAll('details.fold')];
  const items = [...graph.querySelectorAll('.graph .item')].map(
      item => ({item, text: item.textContent.toLowerCase()}));
  field.addEventListener('input', () => {
    const wanted = field.value.trim().toLowerCase();
    let matches = 0;
    for (const {item, text} of items) {
      const met = wanted !== '' && text.includes(wanted);
      item.classList.toggle('match', met);
      item.classList.toggle('dim', wanted !== '' && !met);
      if (met && item.closest('details.fold')) ++matches;
    }
    for (const fold of folds) fold.open = wanted !== '' && fold.querySelector('.match') !== null;
    number.textContent = wanted === '' ? '' : `${matches} nodes and topics`;
  });
  field.addEventListener('keydown', event => {
    const first = graph.querySelector('details.fold .match');
    if (event.key === 'Enter' && first) first.scrollIntoView({block: 'center', inline: 'center'});
  });
}
