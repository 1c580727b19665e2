// A CAN channel over our socketcand hub, shaped as the npm package `canopen` wants it: send({id, data}), 'message' events.
//
// The words (server's side: sim_bus/canopen/socketcand.py): `< hi >`, then `< open can0 >` and `< rawmode >`, each answered by
// `< ok >`; from then on `< send 123 2 a 1f >` goes out and `< frame 123 1700000000.123456 0A1F >` comes in.

import { EventEmitter } from 'node:events';
import net from 'node:net';
import { createRequire } from 'node:module';
import path from 'node:path';

/** The package, from the folder in whose node_modules it was installed: the variable TDHIL_NPM_CANOPEN. */
export function canopen() {
    return createRequire(path.join(process.env.TDHIL_NPM_CANOPEN, 'package.json'))('canopen');
}

/** One line of JSON on stdout: what the test reads. */
export function tell(what) {
    process.stdout.write(JSON.stringify(what) + '\n');
}

export class Channel extends EventEmitter {
    /** Resolves once frames can be sent. */
    static open(host, port, name = 'can0') {
        const channel = new Channel();
        return new Promise((resolve, reject) => {
            const socket = channel.socket = net.connect(Number(port), host);
            socket.setNoDelay(true);
            socket.on('error', reject);
            socket.on('close', () => channel.emit('close'));
            const answers = [['hi', `< open ${name} >`], ['ok', '< rawmode >'], ['ok', null]];
            let rest = '';
            socket.on('data', (chunk) => {
                const words = (rest + chunk.toString('latin1')).split('>');
                rest = words.pop();
                for (const word of words) {
                    const parts = word.replace('<', '').trim().split(/\s+/);
                    if (parts[0] === 'frame') {
                        channel._take(parts);
                    } else if (answers.length && parts[0] === answers[0][0]) {
                        const next = answers.shift()[1];
                        if (next) socket.write(next);
                        else resolve(channel);
                    } else {
                        reject(new Error(`socketcand said ${word}`));
                    }
                }
            });
        });
    }

    /** 11-bit identifiers alone: the package knows no others. */
    _take([, id, , data]) {
        if (id.length > 3) return;
        const message = { id: parseInt(id, 16), data: Buffer.from(data ?? '', 'hex') };
        message.len = message.data.length;
        this.emit('message', message);
    }

    send({ id, data }) {
        const bytes = [...data].map((byte) => ' ' + byte.toString(16)).join('');
        this.socket.write(`< send ${id.toString(16).padStart(3, '0')} ${data.length}${bytes} >`);
    }

    /** The next frame that `wanted` takes; null after `timeoutMs`. */
    next(wanted, timeoutMs = 20000) {
        return new Promise((resolve) => {
            const end = (message) => {
                clearTimeout(timer);
                this.off('message', look);
                resolve(message);
            };
            const look = (message) => { if (wanted(message)) end(message); };
            const timer = setTimeout(() => end(null), timeoutMs);
            this.on('message', look);
        });
    }

    close() {
        this.socket.destroy();
    }
}
