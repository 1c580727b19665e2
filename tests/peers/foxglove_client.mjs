// A viewer by the npm package `@foxglove/ws-protocol`: subscribes to all that is advertised, and tells what it gets.
//
// node foxglove_client.mjs URL SUBPROTOCOL: a line of JSON each for serverInfo, a channel, a message (payload in hex) and
// a status; ends with its standard input.

import { createRequire } from 'node:module';
import path from 'node:path';

const require = createRequire(path.join(process.env.TDHIL_NPM_FOXGLOVE, 'package.json'));
const { FoxgloveClient } = require('@foxglove/ws-protocol');
const WebSocket = require('ws');

const [url, protocol] = process.argv.slice(2);
const tell = (what) => process.stdout.write(JSON.stringify(what) + '\n');
const topics = new Map();              // of each subscription
const subscribed = new Set();

const socket = new WebSocket(url, [protocol]);
const client = new FoxgloveClient({ ws: socket });
client.on('open', () => tell({ open: socket.protocol }));
client.on('error', (error) => { tell({ error: String(error) }); process.exit(1); });
client.on('close', (event) => { tell({ close: [event.code, event.reason] }); process.exit(0); });
client.on('serverInfo', ({ op, ...said }) => tell({ info: said }));
client.on('status', ({ level, message }) => tell({ status: [level, message] }));
client.on('advertise', (channels) => {
    for (const channel of channels) {
        if (subscribed.has(channel.id)) continue;
        subscribed.add(channel.id);
        topics.set(client.subscribe(channel.id), channel.topic);
        tell({ channel });
    }
});
client.on('message', ({ subscriptionId, timestamp, data }) => tell({
    message: [topics.get(subscriptionId), String(timestamp),
              Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString('hex')],
}));
process.stdin.on('end', () => process.exit(0)).resume();
