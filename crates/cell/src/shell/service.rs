//! The gRPC adapter of the ground truth.

use super::keeper::{Keeper, KeeperError, State};
use crate::config::MAX_BOXES;
use crate::core::boxes::TrueBox;
use crate::core::faults::{Fault, FaultError, MAX_FAULTS};
use crate::core::protocol::Event;
use crate::core::snapshot::Snapshot;
use ratn_model::pose::Pose;
use ratn_proto::convert::name;
use ratn_proto::v1;
use ratn_proto::v1::cell_service_server::CellService;
use tonic::{Request, Response, Status};

pub(crate) struct Service {
    keeper: Keeper,
}

impl Service {
    pub(crate) fn new(keeper: Keeper) -> Service {
        Service { keeper }
    }
}

#[tonic::async_trait]
impl CellService for Service {
    async fn get_ground_truth(
        &self,
        _: Request<v1::GetGroundTruthRequest>,
    ) -> Result<Response<v1::GetGroundTruthResponse>, Status> {
        let state = self.keeper.state().await.map_err(status)?;
        Ok(Response::new(v1::GetGroundTruthResponse {
            battery_level: state.battery,
            base: Some(pose(&state.base)),
            arm: Some(v1::Joints { positions: state.arm.to_vec() }),
            time_s: state.now.seconds(),
            seed: state.seed,
            boxes: boxes(state),
        }))
    }

    async fn reset(&self, request: Request<v1::ResetRequest>) -> Result<Response<v1::ResetResponse>, Status> {
        let v1::ResetRequest { seed, boxes: count } = request.into_inner();
        let count = usize::try_from(count).unwrap_or(usize::MAX);
        if !(1..=MAX_BOXES).contains(&count) {
            return Err(Status::invalid_argument(format!("{count} boxes: a table has 1 to {MAX_BOXES}")));
        }
        let state = self.keeper.reset(seed, count).await.map_err(status)?;
        if state.boxes.len() != count {
            let message = format!("no feasible table with {count} boxes was found from seed {seed}; try another seed");
            return Err(Status::failed_precondition(message));
        }
        Ok(Response::new(v1::ResetResponse { boxes: boxes(state) }))
    }

    async fn save(&self, _: Request<v1::SaveRequest>) -> Result<Response<v1::SaveResponse>, Status> {
        let snapshot = self.keeper.save().await.map_err(status)?;
        Ok(Response::new(v1::SaveResponse { snapshot: snapshot.to_json() }))
    }

    async fn put_back(&self, request: Request<v1::PutBackRequest>) -> Result<Response<v1::PutBackResponse>, Status> {
        let snapshot = Snapshot::from_json(&request.into_inner().snapshot)
            .map_err(|error| Status::invalid_argument(error.to_string()))?;
        self.keeper.tell(Event::PutBack { snapshot: Box::new(snapshot) }).await.map_err(status)?;
        let state = self.keeper.state().await.map_err(status)?;
        Ok(Response::new(v1::PutBackResponse { boxes: boxes(state) }))
    }

    async fn inject_fault(
        &self,
        request: Request<v1::InjectFaultRequest>,
    ) -> Result<Response<v1::InjectFaultResponse>, Status> {
        let text = request.into_inner().fault;
        name(&text, "fault")?;
        let fault: Fault = text.parse().map_err(|error: FaultError| Status::invalid_argument(error.to_string()))?;
        if self.keeper.inject(fault).await.map_err(status)? {
            Ok(Response::new(v1::InjectFaultResponse {}))
        } else {
            Err(Status::resource_exhausted(format!("{MAX_FAULTS} faults are still to come: no more are taken")))
        }
    }
}

fn boxes(state: State) -> Vec<v1::TrueBox> {
    let wire = |b: TrueBox| v1::TrueBox {
        id: b.id,
        pose: Some(pose(&b.pose)),
        size_m: b.size.to_vec(),
        on_base: b.on_base,
        held: b.held,
        rests_on: b.on,
    };
    state.boxes.into_iter().map(wire).collect()
}

fn pose(pose: &Pose) -> v1::Pose {
    v1::Pose { position_m: pose.position.to_vec(), quaternion_xyzw: pose.quaternion_xyzw.to_vec() }
}

fn status(error: KeeperError) -> Status {
    match error {
        KeeperError::Overloaded => Status::resource_exhausted(error.to_string()),
        KeeperError::Ended => Status::unavailable(error.to_string()),
    }
}
