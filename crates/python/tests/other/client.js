// A client of plain @grpc/grpc-js at the socket of a resource manager: the kinds of its resources, a line each.
//
//     node client.js unix:/path/of/the.sock PROTO_FOLDER
const grpc = require("@grpc/grpc-js");
const loader = require("@grpc/proto-loader");

const [address, folder] = process.argv.slice(2);
const definition = loader.loadSync("ratn/v1/resources.proto", { includeDirs: [folder], keepCase: true });
const { ResourceService } = grpc.loadPackageDefinition(definition).ratn.v1;
new ResourceService(address, grpc.credentials.createInsecure()).List({}, (error, answer) => {
  if (error) throw error;
  for (const resource of answer.resources) console.log(resource.kind);
});
