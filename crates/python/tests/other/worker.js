// A worker of plain @grpc/grpc-js, with every setting as it is by default.
//
//     node worker.js ENDPOINT_FILE PROTO_FOLDER
const fs = require("node:fs");
const grpc = require("@grpc/grpc-js");
const loader = require("@grpc/proto-loader");

const [endpointFile, folder] = process.argv.slice(2);
const load = (file, dirs) =>
  grpc.loadPackageDefinition(loader.loadSync(file, { includeDirs: dirs, keepCase: true, longs: Number, oneofs: true }));
const { ActionService } = load("ratn/v1/action.proto", [folder]).ratn.v1;
const { Health } = load("health.proto", [__dirname]).grpc.health.v1;

const result = { outcome: "success", outputs: { by: { text: "grpc-js" } } };
const server = new grpc.Server();
server.addService(ActionService.service, {
  Perform(call) {
    call.on("data", (request) => {
      if (request.kind !== "execute") return;
      const seconds = request.execute.goal.inputs.seconds.number;
      setTimeout(() => call.write({ id: request.id, result }), seconds * 1000);
    });
    call.on("end", () => call.end());
  },
});
server.addService(Health.service, {
  Check: (call, answer) => answer(null, { status: "SERVING" }),
});
server.bindAsync("127.0.0.1:0", grpc.ServerCredentials.createInsecure(), (error, port) => {
  if (error) throw error;
  fs.writeFileSync(`${endpointFile}.new`, `http://127.0.0.1:${port}\n`);
  fs.renameSync(`${endpointFile}.new`, endpointFile);
});
