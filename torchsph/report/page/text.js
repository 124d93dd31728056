// Tables and lists. Text of files enters by textContent alone, never as markup.
function made(name, text, className) {
  const found = document.createElement(name);
  if (text !== undefined) found.textContent = text;
  if (className) found.className = className;
  return found;
}

function tableOf(heading, rows) {
  const table = made("table");
  const head = made("thead");
  const line = made("tr");
  for (const name of heading) {
    const cell = made("th", name);
    cell.scope = "col";
    line.append(cell);
  }
  head.append(line);
  const body = made("tbody");
  for (const row of rows) {
    const tr = made("tr");
    for (const cell of row) {
      if (cell instanceof Node) {
        const td = made("td");
        td.append(cell);
        tr.append(td);
      } else tr.append(made("td", cell));
    }
    body.append(tr);
  }
  table.append(head, body);
  return table;
}

function showChecks(place, checks) {
  const rows = checks.map(({ name, verdict, found, means }) => {
    const word = made("span", verdict, `verdict ${["good", "fair", "poor"].includes(verdict) ? verdict : "unknown"}`);
    return [made("strong", name), word, found, means];
  });
  place.append(tableOf(["What", "Verdict", "Found", "What it means"], rows));
}

/** A mapping as names and values; what is nested gets a fold of its own. */
function showAccount(place, account) {
  const list = made("dl");
  const nested = [];
  for (const [name, value] of Object.entries(account)) {
    if (value !== null && typeof value === "object" && !Array.isArray(value)) nested.push([name, value]);
    else list.append(made("dt", name), made("dd", told(value)));
  }
  if (list.childNodes.length) place.append(list);
  for (const [name, value] of nested) {
    const fold = made("details");
    fold.append(made("summary", name));
    showAccount(fold, value);
    place.append(fold);
  }
}

function told(value) {
  if (value === null) return "–";
  return Array.isArray(value) ? value.map(told).join(", ") : typeof value === "object" ? JSON.stringify(value) : String(value);
}
