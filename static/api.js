// Lists what /api offers from its OpenAPI description, without loading anything from elsewhere.

const element = (tag, properties = {}, ...children) => {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
};

/** A schema in a few words. */
function words(schema) {
  if (!schema) return "";
  if (schema.$ref) return schema.$ref.split("/").at(-1);
  if (schema.anyOf) return schema.anyOf.map(words).join(" or ");
  if (schema.enum) return schema.enum.map((value) => JSON.stringify(value)).join(" | ");
  if (schema.const !== undefined) return JSON.stringify(schema.const);
  if (schema.type === "array") return schema.items ? `list of ${words(schema.items)}` : "list";
  const limits = [["minimum", "≥"], ["exclusiveMinimum", ">"], ["maximum", "≤"]]
    .filter(([name]) => schema[name] !== undefined).map(([name, sign]) => `${sign} ${schema[name]}`);
  return [schema.type, ...limits].join(" ");
}

function operation(path, method, described) {
  const name = element("summary", {}, element("span", { className: "method", textContent: method.toUpperCase() }),
    element("code", { textContent: path }));
  const rows = [];
  for (const parameter of described.parameters ?? []) rows.push([parameter.name, words(parameter.schema)]);
  const body = described.requestBody?.content?.["application/json"]?.schema;
  if (body) rows.push(["sends", words(body)]);
  for (const [status, answer] of Object.entries(described.responses)) {
    rows.push([status, words(answer.content?.["application/json"]?.schema) || answer.description]);
  }
  return element("details", { open: true }, name, element("p", { textContent: described.description ?? "" }), table(rows));
}

const table = (rows) => element("table", {}, ...rows.map(([name, text]) => element("tr", {},
  element("td", {}, element("code", { textContent: name })), element("td", { textContent: text }))));

const described = await (await fetch("openapi.json")).json();
document.getElementById("about").textContent = described.info.description;
for (const [path, methods] of Object.entries(described.paths)) {
  for (const [method, one] of Object.entries(methods)) document.getElementById("paths").append(operation(path, method, one));
}
for (const [name, schema] of Object.entries(described.components.schemas)) {
  const rows = Object.entries(schema.properties ?? {}).map(([key, value]) => [key, words(value)]);
  document.getElementById("types").append(element("details", {}, element("summary", {}, element("code", { textContent: name })),
    element("p", { textContent: schema.description ?? "" }), table(rows)));
}
