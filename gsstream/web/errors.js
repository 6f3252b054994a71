// What every module of the decoder throws, and where it happened.

/** A stream is damaged, cut short or of another version. `offset` is the byte of the file at which reading failed. */
export class PacketError extends Error {
  constructor(message, offset = null) {
    super(offset === null ? message : `${message} (at byte ${offset})`);
    this.name = "PacketError";
    this.offset = offset;
  }
}

/** Run `read`; a PacketError that does not know where it happened gets the offset of the section being read. */
export function located(offset, read) {
  try {
    return read();
  } catch (error) {
    if (error instanceof PacketError && error.offset === null) throw new PacketError(error.message, offset);
    throw error;
  }
}

/** What `read` makes of the bytes of a section `{ data, offset }`; null where there is no section. */
export function ofSection(section, read) {
  return section ? located(section.offset, () => read(section.data)) : null;
}
