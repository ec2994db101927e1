/** What a page holds, as text in elements that nothing runs. */

/** The text of an element, which is gone after that. */
export function take(id: string): string {
  const element = document.getElementById(id);
  const held = element?.textContent ?? "";
  element?.remove();
  return held;
}

/** Base64 to bytes. */
export function decode(text: string): Uint8Array<ArrayBuffer> {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i += 1) bytes[i] = binary.charCodeAt(i);
  return bytes;
}
