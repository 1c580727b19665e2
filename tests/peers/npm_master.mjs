// A foreign CANopen master against our simulated drive: node npm_master.mjs HOST PORT NODE
//
// The transfers, the NMT commands, the heartbeats, EMCY and PDOs are the npm package's; what is wanted of the drive was
// typed from CiA 301 and 402. Each step tells what it found as one line of JSON; the test judges.

import { Channel, canopen, tell } from './socketcand_channel.mjs';

const [host, port, nodeText] = process.argv.slice(2);
const node = Number(nodeText);
const { Device, DataType } = canopen();
const OWN = 0x7E;                      // our own node id, whose heartbeat the drive consumes
const CYCLE_US = 4000;

const channel = await Channel.open(host, port);
const device = new Device({ id: OWN });
device.on('message', (message) => channel.send(message));
channel.on('message', (message) => device.receive(message));
device.eds.addSdoClientParameter(node, 0x600 + node, 0x580 + node);
device.eds.addHeartbeatConsumer(node, 2000);
device.eds.addEmcyConsumer(0x80 + node);
const emergencies = [];
device.emcy.on('emergency', ({ em }) => emergencies.push(em.code));
device.start();

const read = (index, subIndex, dataType) =>
    device.sdo.upload({ serverId: node, index, subIndex, dataType, timeout: 5000 });
const write = (index, subIndex, data, dataType) =>
    device.sdo.download({ serverId: node, index, subIndex, data, dataType, timeout: 5000 });
const refused = async (transfer) => {
    try {
        await transfer;
        return null;
    } catch (error) {
        return error.code ?? String(error);
    }
};
const { UNSIGNED8, UNSIGNED16, UNSIGNED32, INTEGER8, INTEGER16, INTEGER32, VISIBLE_STRING } = DataType;

// -- SDO -------------------------------------------------------------------------------------------------------------
tell({
    step: 'sdo',
    device_type: await read(0x1000, 0, UNSIGNED32),
    name: await read(0x1008, 0, VISIBLE_STRING),
    marker: await read(0x5FFE, 1, VISIBLE_STRING),
    identity: [await read(0x1018, 1, UNSIGNED32), await read(0x1018, 2, UNSIGNED32), await read(0x1018, 3, UNSIGNED32)],
    modes: await read(0x6502, 0, UNSIGNED32),
    no_object: await refused(read(0x5000, 0, UNSIGNED8)),
    no_sub: await refused(read(0x1018, 9, UNSIGNED32)),
    read_only: await refused(write(0x6041, 0, 1, UNSIGNED16)),
    beyond_its_range: await refused(write(0x5FFE, 2, 7, UNSIGNED8)),
    block: await device.sdo.upload({
        serverId: node, index: 0x5FFE, subIndex: 1, dataType: VISIBLE_STRING, blockTransfer: true, timeout: 5000,
    }),
});
await write(0x6060, 0, 3, INTEGER8);
tell({ step: 'mode', shown: await read(0x6061, 0, INTEGER8) });

// -- NMT and heartbeat -----------------------------------------------------------------------------------------------
const beat = () => channel.next(({ id }) => id === 0x700 + node).then((message) => message && message.data[0]);
const boot = beat();
device.nmt.resetNode(node);
const bootUp = await boot;
await write(0x1017, 0, 50, UNSIGNED16);
const states = [];
for (const [command, wanted] of [['startNode', 5], ['stopNode', 4], ['enterPreOperational', 127]]) {
    device.nmt[command](node);
    await channel.next(({ id, data }) => id === 0x700 + node && data[0] === wanted);
    states.push(await device.nmt.getNodeState(node));
    if (command === 'stopNode')        // a stopped node serves no SDO
        states.push(await refused(device.sdo.upload({ serverId: node, index: 0x1000, timeout: 500 })) !== null);
}
tell({ step: 'nmt', boot_up: bootUp, states });

// -- PDO, in stepped time --------------------------------------------------------------------------------------------
const map = async (communication, mapping, cobId, entries) => {
    await write(communication, 1, (cobId | 0x80000000) >>> 0, UNSIGNED32);
    await write(mapping, 0, 0, UNSIGNED8);
    for (const [k, entry] of entries.entries()) await write(mapping, k + 1, entry, UNSIGNED32);
    await write(mapping, 0, entries.length, UNSIGNED8);
    await write(communication, 2, 1, UNSIGNED8);
    await write(communication, 1, cobId, UNSIGNED32);
};
await map(0x1400, 0x1600, 0x200 + node, [0x60400010, 0x60710010, 0x60FF0020]);
await map(0x1800, 0x1A00, 0x180 + node, [0x60410010, 0x60770010, 0x606C0020]);
const entry = (index, dataType) => device.eds.addEntry(index, { parameterName: 'mirror', dataType });
const control = entry(0x2040, UNSIGNED16), torque = entry(0x2071, INTEGER16), velocity = entry(0x20FF, INTEGER32);
const status = entry(0x2041, UNSIGNED16), actualTorque = entry(0x2077, INTEGER16), actual = entry(0x206C, INTEGER32);
device.eds.addTransmitPdo({ cobId: 0x200 + node, transmissionType: 255, dataObjects: [control, torque, velocity] });
device.eds.addReceivePdo({ cobId: 0x180 + node, transmissionType: 1, dataObjects: [status, actualTorque, actual] });
device.nmt.startNode();                // ourselves: the package sends PDOs only when operational
device.eds.setSyncCobId(0x80);
device.eds.setSyncGenerationEnable(true);
await write(0x1006, 0, CYCLE_US, UNSIGNED32);
await write(0x5FFE, 2, 1, UNSIGNED8);
await write(0x6060, 0, 3, INTEGER8);
await write(0x6007, 0, 3, INTEGER16);
await write(0x605A, 0, 6, INTEGER16);       // after a quick stop: stay in it, held
// Armed by the first heartbeat; in plant time, which moves with our SYNC.
await write(0x1016, 1, (OWN << 16) | 500, UNSIGNED32);
device.nmt.startNode(node);
let cycles = 0;
const cycle = async (word, target = 0) => {
    if (cycles++ % 25 === 0) channel.send({ id: 0x700 + OWN, data: Buffer.from([5]) });
    control.value = word;
    velocity.value = target;
    device.pdo.write(0x200 + node);
    const answer = channel.next(({ id }) => id === 0x180 + node);
    device.sync.write();
    if (await answer === null) throw new Error('no TPDO');
    return status.value & 0x6F;
};
const until = async (word, wanted) => {
    for (let k = 0; k < 100; ++k) if (await cycle(word) === wanted) return true;
    return false;
};
const walked = [await until(0x06, 0x21), await until(0x07, 0x23), await until(0x0F, 0x27)];
const run = async (seconds, word, target) => {
    for (let k = 0; k < seconds * 1e6 / CYCLE_US; ++k) await cycle(word, target);
};
await run(10, 0x0F, 300);              // 0.1 rpm a count: 30 rpm
const turning = { velocity: actual.value, torque: actualTorque.value };
await run(0.004, 0x0B, 300);
const stopping = status.value & 0x6F;
await run(4, 0x0B, 300);
const stopped = { velocity: actual.value, state: status.value & 0x6F };
const disabled = await until(0x00, 0x40);
tell({ step: 'pdo', walked, turning, stopping, stopped, disabled });

// -- the drive's watchdog on our heartbeat ---------------------------------------------------------------------------
for (const [word, wanted] of [[0x06, 0x21], [0x07, 0x23], [0x0F, 0x27]]) await until(word, wanted);
await run(3, 0x0F, 300);
const before = actual.value;
// SYNC and RPDO go on, the heartbeat doesn't. A node that lost it leaves OPERATIONAL (1029h), and with it its PDOs end:
// from there on SDO alone tells how the shaft fares, and keeps pace with the SYNCs.
let state = 0;
for (let k = 0; k < 6e6 / CYCLE_US; ++k) {
    velocity.value = 300;
    device.pdo.write(0x200 + node);
    device.sync.write();
    if (k % 25 === 24) state = await read(0x6041, 0, UNSIGNED16) & 0x6F;
}
tell({
    step: 'watchdog', before, after: await read(0x606C, 0, INTEGER32), state, emergencies,
    nmt: await device.nmt.getNodeState(node), error_code: await read(0x603F, 0, UNSIGNED16),
});
device.stop();
channel.close();
