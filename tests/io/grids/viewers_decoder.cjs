// Print the messages of an MCAP as JSON, decoded by the libraries of the viewers (Foxglove, Lichtblick).
const fs = require("fs");
const { McapStreamReader } = require("@mcap/core");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const { decompress } = require("fzstd");

const reader = new McapStreamReader({ decompressHandlers: { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) } });
reader.append(fs.readFileSync(process.argv[2]));
const schemas = new Map(), channels = new Map(), found = [];
for (let record; (record = reader.nextRecord()); ) {
  if (record.type === "Schema") schemas.set(record.id, parse(new TextDecoder().decode(record.data), { ros2: true }));
  else if (record.type === "Channel") channels.set(record.id, record);
  else if (record.type === "Message") {
    const channel = channels.get(record.channelId);
    found.push({ topic: channel.topic, message: new MessageReader(schemas.get(channel.schemaId)).readMessage(record.data) });
  }
}
const plain = (_, value) => (typeof value === "bigint" ? Number(value) : ArrayBuffer.isView(value) ? Array.from(value) : value);
console.log(JSON.stringify(found, plain));
