"use strict";
// history.js URL QUESTIONS: reads the history of nodes as opcua_history.py does: a JSON list of questions, a JSON line for each
// answer, which is read to its end.
const {
  HistoryReadRequest, MessageSecurityMode, OPCUAClient, ReadProcessedDetails, ReadRawModifiedDetails, SecurityPolicy,
  TimestampsToReturn,
} = require("node-opcua-client");
const { AggregateFunction } = require("node-opcua-constants");

const EPOCH = Date.UTC(2023, 10, 14, 22, 13, 20);
const when = (milliseconds) => (milliseconds === null || milliseconds === undefined ? null : new Date(EPOCH + milliseconds));

function detailsOf(question) {
  const span = { startTime: when(question.start), endTime: when(question.end) };
  if (question.aggregate) {
    return new ReadProcessedDetails({
      ...span,
      processingInterval: question.interval,
      aggregateType: [AggregateFunction[question.aggregate]],
      aggregateConfiguration: { useServerCapabilitiesDefaults: true },
    });
  }
  return new ReadRawModifiedDetails({
    ...span,
    isReadModified: false,
    numValuesPerNode: question.count || 0,
    returnBounds: question.bounds || false,
  });
}

async function asked(session, question) {
  const values = [];
  let [answers, continuationPoint] = [0, undefined];
  for (;;) {
    const response = await session.historyRead(new HistoryReadRequest({
      historyReadDetails: detailsOf(question),
      nodesToRead: [{ nodeId: question.node, continuationPoint }],
      releaseContinuationPoints: false,
      timestampsToReturn: TimestampsToReturn.Both,
    }));
    const [result] = response.results;
    answers += 1;
    for (const data of (result.historyData && result.historyData.dataValues) || []) {
      const time = data.sourceTimestamp ? data.sourceTimestamp.getTime() - EPOCH : null;
      const value = data.value && data.value.value !== undefined ? data.value.value : null;
      values.push([time, value, data.statusCode.value]);
    }
    continuationPoint = result.continuationPoint;
    if (!continuationPoint || continuationPoint.length === 0) {
      return { status: result.statusCode.name, answers, values };
    }
  }
}

async function main([url, questions]) {
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode.None,
    securityPolicy: SecurityPolicy.None,
    connectionStrategy: { maxRetry: 3 },
  });
  await client.connect(url);
  const session = await client.createSession();
  for (const question of JSON.parse(questions)) {
    console.log(JSON.stringify(await asked(session, question)));
  }
  await session.close();
  await client.disconnect();
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
