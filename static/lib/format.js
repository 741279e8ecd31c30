// Numbers for people. `unit` is the state's: metres for rooms, else lengths are shares of the diameter.

export const count = (value) => value.toLocaleString("en-US");
export const percent = (share, digits = 1) => (share === null ? "–" : `${(100 * share).toFixed(digits)} %`);
export const significant = (value, digits) => String(Number(value.toPrecision(digits)));

const isRelative = (unit) => unit.name !== "m";

/** A length in cloud units: centimetres and metres in rooms, shares of the diameter for objects. */
export function length(value, unit, digits = 2) {
  if (value === null) return "–";
  if (isRelative(unit)) return `${significant((100 * value) / unit.diameter, digits)} % diam.`;
  const metres = value * unit.metres;
  return metres < 0.9995 ? `${significant(100 * metres, digits)} cm` : `${significant(metres, digits + 1)} m`;
}

/** Unit of the fields, and what one of it is in the units of the clouds. */
export const field = (unit) => (isRelative(unit) ? { name: "% ⌀", size: unit.diameter / 100 } : { name: "m", size: 1 / unit.metres });

/** Unit of an axis that ends at `last`, and what one of it is in the units of the clouds. */
export function axisUnit(last, unit) {
  if (isRelative(unit)) return { name: "% of diameter", size: unit.diameter / 100 };
  return last * unit.metres < 1 ? { name: "cm", size: 0.01 / unit.metres } : { name: "m", size: 1 / unit.metres };
}

/** A number of the diagnosis: a share, count, length, angle, or ratio. */
export function quantity(value, kind, unit) {
  if (kind === "share") return percent(value, 0);
  if (kind === "count") return count(Math.round(value));
  if (kind === "length") return length(value, unit);
  if (kind === "degrees") return `${Math.round(value)}°`;
  return value >= 100 ? count(Math.round(value)) : significant(value, 2);
}
