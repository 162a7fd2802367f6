"""A worker of plain grpcio, with every setting as it is by default: no SDK, no options, no initial metadata.

    worker.py ENDPOINT_FILE PROTOS

PROTOS is a folder with what `grpc_tools.protoc` made of `proto/ratn/v1/action.proto`.
"""

import asyncio
import os
import sys

endpoint_file, protos = sys.argv[1:]
sys.path.insert(0, protos)

import grpc  # noqa: E402
from grpc_health.v1 import health, health_pb2, health_pb2_grpc  # noqa: E402
from ratn.v1 import action_pb2, action_pb2_grpc, value_pb2  # noqa: E402


class Actions(action_pb2_grpc.ActionServiceServicer):
    async def Perform(self, requests, context):
        async for request in requests:
            if request.WhichOneof("kind") == "execute":
                yield action_pb2.PerformResponse(id=request.id, result=await self.ended(request.execute.goal))

    async def ended(self, goal):
        await asyncio.sleep(goal.inputs["seconds"].number)
        return action_pb2.GoalResult(outcome="success", outputs={"by": value_pb2.Value(text="grpcio")})


async def main():
    server = grpc.aio.server()
    action_pb2_grpc.add_ActionServiceServicer_to_server(Actions(), server)
    status = health.aio.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(status, server)
    await status.set("", health_pb2.HealthCheckResponse.SERVING)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    with open(endpoint_file + ".new", "w") as file:
        file.write(f"http://127.0.0.1:{port}\n")
    os.replace(endpoint_file + ".new", endpoint_file)
    await server.wait_for_termination()


asyncio.run(main())
