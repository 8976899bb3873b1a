"use strict";
// alarms.js URL NODE: watches the alarms of a server by node-opcua's list of alarms, which
// refreshes the conditions itself. It acknowledges and comments the first alarm of the source NODE
// that is active, and says what it saw: a JSON line for each change.
const {
  MessageSecurityMode, OPCUAClient, SecurityPolicy, installAlarmMonitoring, uninstallAlarmMonitoring,
} = require("node-opcua-client");

function say(line) {
  console.log(JSON.stringify(line));
}

function described(alarm) {
  const fields = alarm.fields;
  const id = (name) => fields[name] && fields[name].id && fields[name].id.value;
  return {
    condition: alarm.conditionId.toString(),
    name: fields.conditionName.value,
    message: fields.message.value.text,
    severity: fields.severity.value,
    retain: alarm.getRetain(),
    active: id("activeState"),
    acked: id("ackedState"),
    user: fields.clientUserId.value,
    comment: fields.comment.value && fields.comment.value.text,
  };
}

async function main([url, node]) {
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode.None,
    securityPolicy: SecurityPolicy.None,
    connectionStrategy: { maxRetry: 3 },
  });
  await client.connect(url);
  const session = await client.createSession();
  const alarms = await installAlarmMonitoring(session);
  const done = new Promise((resolve, reject) => {
    let acknowledged = false;
    const changed = (alarm) => {
      if (alarm.fields.sourceNode.value.toString() !== node) {
        return;
      }
      const shown = described(alarm);
      say(shown);
      if (shown.active && !acknowledged) {
        acknowledged = true;
        session
          .acknowledgeCondition(alarm.conditionId, alarm.eventId, "seen by node-opcua")
          .then((status) => say({ acknowledge: status.name }), reject);
      }
      if (shown.acked && acknowledged) {
        resolve();
      }
    };
    alarms.on("newAlarm", changed);
    alarms.on("alarmChanged", changed);
    for (const alarm of alarms.alarms()) {
      changed(alarm);
    }
  });
  say({ ready: true });
  await done;
  await uninstallAlarmMonitoring(session);
  await session.close();
  await client.disconnect();
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
