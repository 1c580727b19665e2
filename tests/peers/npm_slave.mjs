// A foreign CANopen slave for our driver: node npm_slave.mjs HOST PORT NODE
//
// Object dictionary, SDO server, NMT, heartbeats and PDOs are the npm package's. The state machine of CiA 402 and a
// rigid shaft, neither of which it has, are typed here; they share nothing with the simulator. The shaft moves by the
// period of 1006h at each SYNC, and the drive wears the simulator's marker: it is one. Torque counts per mille of
// 1000 N·m, velocity 0.1 rpm, as in the generic profile.

import { Channel, canopen, tell } from './socketcand_channel.mjs';

const [host, port, nodeText] = process.argv.slice(2);
const node = Number(nodeText);
const { Device, DataType, ObjectType } = canopen();
const { UNSIGNED8, UNSIGNED16, UNSIGNED32, INTEGER8, INTEGER16, INTEGER32, VISIBLE_STRING } = DataType;
const INERTIA = 60, VISCOUS = 6, COULOMB = 40;         // kg·m², N·m·s/rad, N·m
const SPEED_GAIN = 400, ACCELERATION = 2;              // N·m·s/rad, rad/s²
const LSB = 0.1 * Math.PI / 30;                        // rad/s a count

const channel = await Channel.open(host, port);
const device = new Device({ id: node });
const { eds } = device;

for (const index of [0x1000, 0x1001, 0x1018]) eds.removeEntry(index);      // what the package starts from
const variable = (index, dataType, value = 0, accessType = 'rw') => {
    const entry = eds.addEntry(index, { parameterName: `object ${index.toString(16)}`, dataType, accessType });
    entry.value = value;
    return entry;
};
const record = (index, subs) => {
    const entry = eds.addEntry(index, { parameterName: `record ${index.toString(16)}`, objectType: ObjectType.RECORD });
    subs.forEach(([dataType, value, accessType = 'rw'], k) => {
        const sub = entry.addSubObject(k + 1, { parameterName: `sub ${k + 1}`, dataType, accessType });
        sub.value = value;
    });
    return entry;
};
variable(0x1000, UNSIGNED32, 0x00020192, 'ro');
variable(0x1001, UNSIGNED8, 0, 'ro');
variable(0x1005, UNSIGNED32, 0x80);
const period = variable(0x1006, UNSIGNED32);
variable(0x1008, VISIBLE_STRING, 'npm canopen drive', 'ro');
record(0x1016, [[UNSIGNED32, 0]]);
const beatTime = variable(0x1017, UNSIGNED16);
record(0x1018, [[UNSIGNED32, 0, 'ro'], [UNSIGNED32, 402, 'ro'], [UNSIGNED32, 0x10000, 'ro'], [UNSIGNED32, 7, 'ro']]);
eds.addSdoServerParameter(0, 0x580 + node, 0x600 + node);
for (const k of [0, 1]) {
    for (const [communication, cobId] of [[0x1400, 0x200], [0x1800, 0x180]]) {
        record(communication + k, [[UNSIGNED32, cobId + 0x100 * k + node], [UNSIGNED8, 255]]);
        record(communication + 0x200 + k, Array.from({ length: 4 }, () => [UNSIGNED32, 0]));
        eds.getEntry(communication + 0x200 + k)[0].accessType = 'rw';
        eds.getEntry(communication + 0x200 + k)[0].value = 0;
    }
}
record(0x5FFE, [[VISIBLE_STRING, 'tdhil simulated drive', 'ro'], [UNSIGNED8, 0]]);
variable(0x6007, INTEGER16, 1);
variable(0x603F, UNSIGNED16, 0, 'ro');
const control = variable(0x6040, UNSIGNED16);
const status = variable(0x6041, UNSIGNED16, 0x40, 'ro');
variable(0x605A, INTEGER16, 2);
const mode = variable(0x6060, INTEGER8);
const shown = variable(0x6061, INTEGER8, 0, 'ro');
const actual = variable(0x606C, INTEGER32, 0, 'ro');
const targetTorque = variable(0x6071, INTEGER16);
const maxTorque = variable(0x6072, UNSIGNED16, 1000);
const demand = variable(0x6074, INTEGER16, 0, 'ro');
variable(0x6076, UNSIGNED32, 1000000, 'ro');
const actualTorque = variable(0x6077, INTEGER16, 0, 'ro');
variable(0x6080, UNSIGNED32, 3000);
const quickStopRamp = variable(0x6085, UNSIGNED32, 191);
variable(0x60A9, UNSIGNED32, 0xFFB44700, 'ro');
const targetVelocity = variable(0x60FF, INTEGER32);
variable(0x6502, UNSIGNED32, 0x30C, 'ro');

// -- state machine and shaft -----------------------------------------------------------------------------------------
const OFF = 0x40, READY = 0x21, SWITCHED_ON = 0x23, ENABLED = 0x27, QUICK_STOP = 0x07;
let state = OFF, speed = 0, ramp = 0, wished = 0;

const follow = (word) => {
    const command = word & 0x0F;
    if (!(command & 0x02)) state = OFF;
    else if (!(command & 0x04)) state = state === ENABLED || state === QUICK_STOP ? QUICK_STOP : OFF;
    else if (state === QUICK_STOP) return;             // not ended by enabling (605Ah = 6)
    else if ((command & 0x07) === 0x06) state = READY;
    else if (command === 0x07 && state !== OFF) state = SWITCHED_ON;
    else if (command === 0x0F && (state === SWITCHED_ON || state === ENABLED)) state = ENABLED;
};
const towards = (from, to, most) => from + Math.max(-most, Math.min(most, to - from));
const clamp = (value, most) => Math.max(-most, Math.min(most, value));

function step(seconds) {
    const before = state;
    follow(control.value);
    if (state !== before) ramp = speed;
    shown.value = mode.value;
    let torque = 0;
    const inTorque = shown.value === 4 || shown.value === 10;
    if (state === ENABLED && inTorque) {
        torque = targetTorque.value;
        ramp = speed;
    } else if (state === ENABLED || state === QUICK_STOP) {
        const braking = quickStopRamp.value * LSB;
        ramp = state === ENABLED ? towards(ramp, targetVelocity.value * LSB, ACCELERATION * seconds)
            : towards(ramp, 0, braking * seconds);
        torque = SPEED_GAIN * (ramp - speed) + COULOMB * Math.sign(ramp) + VISCOUS * ramp;
    }
    torque = clamp(torque, maxTorque.value);
    const free = torque - VISCOUS * speed;
    if (speed === 0 && Math.abs(free) <= COULOMB) {
        speed = 0;
    } else {
        const friction = COULOMB * Math.sign(speed || free);
        const next = speed + (free - friction) / INERTIA * seconds;
        speed = speed !== 0 && next * speed < 0 ? 0 : next;
    }
    const still = Math.abs(speed) < 0.02;
    const slow = still && state === QUICK_STOP;
    status.value = state | 0x10 | (state === OFF ? 0 : 0x200) | (slow ? 0x400 : 0) | (still ? 0x1000 : 0);
    demand.value = Math.round(torque);
    actualTorque.value = Math.round(torque);
    actual.value = Math.round(speed / LSB);
    wished = torque;
}

// -- on the bus ------------------------------------------------------------------------------------------------------
const seen = { syncs: 0, fastest: 0 };
let sinceBeat = 0;
device.on('message', (message) => channel.send(message));
channel.on('message', (message) => {
    if (message.id === 0x80) {
        step(period.value * 1e-6);
        seen.syncs += 1;
        // The package beats by the wall clock alone; where time is stepped the host expects it by plant time as well.
        sinceBeat += period.value / 1000;
        if (beatTime.value > 0 && sinceBeat >= beatTime.value) {
            sinceBeat = 0;
            device.nmt._sendHeartbeat();
        }
        seen.fastest = Math.max(seen.fastest, speed);
    }
    device.receive(message);
    if (message.id === 0x600 + node) {                 // a control word, a mode by SDO
        follow(control.value);
        shown.value = mode.value;
        status.value = (status.value & ~0x6F) | state;
    }
});
device.nmt.on('timeout', (deviceId) => {
    // Its reaction is ours to give: the shaft brakes on its quick-stop ramp, in the machine's own time from now on.
    // In stepped time the package's timer, which knows the wall clock alone, says nothing: a host may think for a while.
    if (eds.getSubEntry(0x5FFE, 2).value === 1 || (state !== ENABLED && state !== QUICK_STOP)) return;
    const turning = speed;
    control.value = 0x0B;
    for (let k = 0; k < 10000 && (speed !== 0 || k < 10); ++k) step(0.004);
    tell({ event: 'heartbeat lost', node: deviceId, turning, speed, state });
});
device.start();
channel.send({ id: 0x700 + node, data: Buffer.from([0]) });     // boot-up: the package sends none
tell({ event: 'ready' });
channel.on('close', () => process.exit(0));
process.on('SIGTERM', () => {
    tell({ event: 'end', speed, state, wished, ...seen });
    device.stop();
    channel.close();
});
