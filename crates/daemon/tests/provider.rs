//! A provider and its resource, against whoever takes that away.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_model::resource::ResourceClass;
use ratn_proto::types::{Resource, ResourceEventKind};
use ratn_worker::client::ResourceClient;
use ratn_worker::provider::Provider;
use support::{TestSystem, in_time};

#[tokio::test]
async fn a_resource_that_somebody_else_deleted_is_offered_again_and_one_that_was_withdrawn_is_not() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let owner = system.client(&manager, "cell@sim").await;
    let provider = Provider::start(&system.channels, &manager.endpoint, &owner.session).unwrap();
    let (mut watch, operator) =
        (system.watch(&manager, &[]).await, ResourceClient::new(&system.channels, &manager.endpoint, "").unwrap());
    assert!(in_time(provider.offer(Resource::new("arm@sim", ResourceClass::Module, "Arm"))).await.unwrap());
    assert_eq!(watch.created("Arm").await.id, "arm@sim");
    for _ in 0..3 {
        operator.delete("arm@sim").await.unwrap();
        let again = watch.event(|event| event.kind == ResourceEventKind::Created).await;
        assert_eq!((again.resource.id.as_str(), again.resource.session.as_str()), ("arm@sim", owner.session.id()));
    }
    assert!(in_time(provider.withdraw("arm@sim")).await.unwrap());
    // Of another kind, so that what is watched changes; what was withdrawn before does not come back with it.
    assert!(in_time(provider.offer(Resource::new("gripper@sim", ResourceClass::Module, "Gripper"))).await.unwrap());
    operator.delete("gripper@sim").await.unwrap();
    let back = std::cell::Cell::new(0);
    watch
        .event(|event| {
            assert!(event.kind != ResourceEventKind::Created || event.resource.id != "arm@sim");
            let created = event.kind == ResourceEventKind::Created && event.resource.id == "gripper@sim";
            back.set(back.get() + usize::from(created));
            back.get() == 2
        })
        .await;
    let there: Vec<String> = operator.list(&[]).await.unwrap().into_iter().map(|r| r.id).collect();
    assert_eq!(there, ["gripper@sim"]);
    drop(provider);
    owner.session.close().await;
    manager.end().await;
}
