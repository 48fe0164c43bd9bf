// Requests to the server that this page came from.  Refusals are thrown as an Error with their one line.

async function answer(response) {
  if (response.ok) return response;
  let text = `${response.status} ${response.statusText}`;
  try { text = (await response.json()).error; } catch { /* no JSON: the status says enough */ }
  throw new Error(text);
}

async function reach(path, options) {
  try { return await fetch(path, { ...options, cache: "no-store", credentials: "omit", redirect: "error" }); }
  catch { throw new Error("gripmon doesn't answer: it has ended"); }
}

export const get = async (path) => (await answer(await reach(path, {}))).json();

export const post = async (path, value) => (await answer(await reach(path, {
  method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value),
}))).json();

export const picture = async (path) => createImageBitmap(await (await answer(await reach(path, {}))).blob());
