//! The gRPC adapter of the ground truth.

use super::cell_actor::{CellActorError, CellHandle, State};
use crate::config::{Goods, MAX_BOXES, MAX_TABLEWARE, Setting};
use crate::core::contacts::Contact;
use crate::core::faults::{Fault, FaultError, MAX_FAULTS};
use crate::core::objects::TrueObject;
use crate::core::placement;
use crate::core::protocol::Event;
use crate::core::snapshot::Snapshot;
use ratn_model::pose::Pose;
use ratn_proto::convert::name;
use ratn_proto::v1;
use ratn_proto::v1::cell_service_server::CellService;
use ratn_worker::access::Caller;
use ratn_worker::audit::{self, Mutation};
use tonic::{Request, Response, Status};

pub(crate) struct Service {
    handle: CellHandle,
    setting: Setting,
}

impl Service {
    pub(crate) fn new(handle: CellHandle, setting: Setting) -> Service {
        Service { handle, setting }
    }

    async fn put_back_to(&self, snapshot: &str) -> Result<Vec<v1::TrueObject>, Status> {
        let robot = self.handle.robot();
        let read = Snapshot::from_json(snapshot).and_then(|snapshot| snapshot.check_robot(robot).map(|()| snapshot));
        let snapshot = read.map_err(|error| Status::invalid_argument(error.to_string()))?;
        self.handle.tell(Event::PutBack { snapshot: Box::new(snapshot) }).await.map_err(status)?;
        Ok(objects(self.handle.state().await.map_err(status)?))
    }

    async fn inject(&self, text: &str) -> Result<(), Status> {
        let fault: Fault = text.parse().map_err(|error: FaultError| Status::invalid_argument(error.to_string()))?;
        if self.handle.inject(fault).await.map_err(status)? {
            return Ok(());
        }
        Err(Status::resource_exhausted(format!("{MAX_FAULTS} faults are still to come: no more are taken")))
    }

    async fn reset_to(
        &self,
        seed: u64,
        count: u32,
        [bowls, forks, cups, plates]: [u32; 4],
    ) -> Result<Vec<v1::TrueObject>, Status> {
        let many = |n: u32| usize::try_from(n).unwrap_or(usize::MAX);
        let goods = Goods {
            boxes: many(count),
            bowls: many(bowls),
            forks: many(forks),
            cups: many(cups),
            plates: many(plates),
        };
        if !goods.fit(self.setting) {
            return Err(Status::invalid_argument(match self.setting {
                Setting::Boxes => format!("{count} boxes: a table has 1 to {MAX_BOXES}"),
                Setting::Table => {
                    format!(
                        "{bowls} bowls, {forks} forks, {cups} cups, {plates} plates: there are 0 to {MAX_TABLEWARE} of each, \
                         and at least one beside the plates"
                    )
                }
            }));
        }
        let (state, count) = (self.handle.reset(seed, goods).await.map_err(status)?, goods.count(self.setting));
        if state.objects.len() != count {
            return Err(Status::failed_precondition(placement::no_scene(count, seed)));
        }
        Ok(objects(state))
    }
}

#[tonic::async_trait]
impl CellService for Service {
    async fn get_ground_truth(
        &self,
        _: Request<v1::GetGroundTruthRequest>,
    ) -> Result<Response<v1::GetGroundTruthResponse>, Status> {
        let state = self.handle.state().await.map_err(status)?;
        Ok(Response::new(v1::GetGroundTruthResponse {
            battery_level: state.battery,
            base: Some(pose(&state.base)),
            arm: Some(v1::Joints { positions: state.arm.to_vec() }),
            time_s: state.now.seconds(),
            seed: state.seed,
            unintended_contacts: state.contacts.iter().map(contact).collect(),
            objects: objects(state),
        }))
    }

    async fn reset(&self, request: Request<v1::ResetRequest>) -> Result<Response<v1::ResetResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::ResetRequest { seed, boxes: count, bowls, forks, cups, plates } = request.into_inner();
        let pending = audit::begin(&caller, "", || Mutation::Reset { seed });
        let reset = self.reset_to(seed, count, [bowls, forks, cups, plates]).await;
        pending.ended(&reset);
        reset.map(|objects| Response::new(v1::ResetResponse { objects }))
    }

    async fn save(&self, _: Request<v1::SaveRequest>) -> Result<Response<v1::SaveResponse>, Status> {
        let snapshot = self.handle.save().await.map_err(status)?;
        Ok(Response::new(v1::SaveResponse { snapshot: snapshot.to_json() }))
    }

    async fn put_back(&self, request: Request<v1::PutBackRequest>) -> Result<Response<v1::PutBackResponse>, Status> {
        let caller = Caller::of(&request);
        let pending = audit::begin(&caller, "", || Mutation::PutBack);
        let put_back = self.put_back_to(&request.into_inner().snapshot).await;
        pending.ended(&put_back);
        put_back.map(|objects| Response::new(v1::PutBackResponse { objects }))
    }

    async fn inject_fault(
        &self,
        request: Request<v1::InjectFaultRequest>,
    ) -> Result<Response<v1::InjectFaultResponse>, Status> {
        let (caller, text) = (Caller::of(&request), request.into_inner().fault);
        name(&text, "fault")?;
        let pending = audit::begin(&caller, "", || Mutation::InjectFault { fault: text.clone() });
        let injected = self.inject(&text).await;
        pending.ended(&injected);
        injected.map(|()| Response::new(v1::InjectFaultResponse {}))
    }
}

fn objects(state: State) -> Vec<v1::TrueObject> {
    let wire = |object: TrueObject| v1::TrueObject {
        id: object.id,
        pose: Some(pose(&object.pose)),
        size_m: object.size.to_vec(),
        on_base: object.on_base,
        held: object.held,
        rests_on: object.on,
        kind: object.kind.name().to_owned(),
        in_place: object.in_place,
        greatest_tilt_rad: object.greatest_tilt_rad,
    };
    state.objects.into_iter().map(wire).collect()
}

fn contact(contact: &Contact) -> v1::UnintendedContact {
    v1::UnintendedContact {
        began_s: contact.began.seconds(),
        ended_s: contact.ended.seconds(),
        bodies: contact.bodies.to_vec(),
        depth_m: contact.depth_m,
        pushed_m: contact.pushed_m,
        at_m: contact.at.to_vec(),
        speed_m_s: contact.speed_m_s,
        meant: contact.meant.map_or_else(String::new, |purpose| purpose.name().to_owned()),
    }
}

fn pose(pose: &Pose) -> v1::Pose {
    v1::Pose { position_m: pose.position.to_vec(), quaternion_xyzw: pose.quaternion_xyzw.to_vec() }
}

fn status(error: CellActorError) -> Status {
    match error {
        CellActorError::Overloaded => Status::resource_exhausted(error.to_string()),
        CellActorError::Ended => Status::unavailable(error.to_string()),
    }
}
