// What the pages share: their nodes, and requests to the server that they came from.

export const $ = (selector, within = document) => within.querySelector(selector);

const SVG = "http://www.w3.org/2000/svg";

function given(node, attributes) {
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
}

export function element(tag, text = "", attributes = {}) {
  const node = given(document.createElement(tag), attributes);
  node.textContent = text;
  return node;
}

// A part of a drawing.
export const shape = (tag, attributes = {}) => given(document.createElementNS(SVG, tag), attributes);

export const setText = (node, text) => { if (node.textContent !== text) node.textContent = text; };

export const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1)}.`;

// The server has ended.
export function over(text) {
  const page = element("div", "", { class: "over" });
  page.append(element("h1", "Done."), element("p", text));
  for (const part of document.body.children) part.hidden = true;
  document.body.append(page);
}

// Refusals are thrown as an Error with their one line.
async function ask(path, options = {}) {
  let response;
  try { response = await fetch(path, { ...options, cache: "no-store", credentials: "omit", redirect: "error" }); }
  catch { throw new Error("gripmon doesn't answer: it has ended"); }
  if (response.ok) return response;
  let text = `${response.status} ${response.statusText}`;
  try { text = (await response.json()).error; } catch { /* no JSON: the status says enough */ }
  throw new Error(text);
}

export const get = async (path) => (await ask(path)).json();

export const post = async (path, value) => (await ask(path, {
  method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value),
})).json();

export const picture = async (path) => createImageBitmap(await (await ask(path)).blob());
