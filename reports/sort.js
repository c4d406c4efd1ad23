"use strict";
// Sorts a table by a column: best values first, as data-up of its head says; a second click turns the order round.
for (const table of document.querySelectorAll("table.values")) {
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const first = head.dataset.up === "1" ? "descending" : "ascending";
      const way = head.getAttribute("aria-sort") !== first ? first : first === "ascending" ? "descending" : "ascending";
      heads.forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", way);
      const key = row => column ? parseFloat(row.cells[column].title) : row.cells[0].textContent;
      const missing = row => column !== 0 && Number.isNaN(key(row));
      const order = (a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : 0) * (way === "ascending" ? 1 : -1);
      for (const body of table.tBodies) {
        const rows = [...body.rows].filter(row => !row.classList.contains("group"));
        rows.sort((a, b) => missing(a) - missing(b) || (missing(a) ? 0 : order(a, b)));
        body.append(...rows);
      }
    });
  });
}
