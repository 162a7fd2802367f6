//! The resource manager is killed at random moments under many clients: nothing that was acknowledged is lost, nothing is granted
//! twice.
//!
//! `RATN_CRASHES` says how often (10), `RATN_SEED` which moments; `scripts/soak-resources` does it 200 times. After every third kill
//! the end of the log is torn as well, as a write is that the machine did not finish.

mod support;

use anyhow::{Context, ensure};
use std::time::{Duration, Instant};
use support::crashes::{Daemon, Random, number};
use support::tool_clients::{CLIENTS, Crowd, told};

#[tokio::test]
async fn a_manager_that_is_killed_again_and_again_loses_nothing_acknowledged_and_grants_nothing_twice()
-> anyhow::Result<()> {
    let (crashes, seed) = (number("RATN_CRASHES", 10), number("RATN_SEED", 4_711));
    println!("{crashes} crashes, RATN_SEED={seed}");
    let mut random = Random(seed | 1);
    let mut manager = Daemon::new("resource-manager")?;
    let mut crowd = Crowd::begin(&manager.endpoint, seed).await?;
    let mut slowest = Duration::ZERO;
    for crash in 0..crashes {
        tokio::time::sleep(Duration::from_millis(20 + random.below(200))).await;
        manager.kill()?;
        if crash % 3 == 2 {
            manager.tear(&mut random)?;
        }
        let begin = Instant::now();
        manager.start()?;
        crowd.verify().await.with_context(|| format!("after crash {crash}: {}", manager.said()))?;
        slowest = slowest.max(begin.elapsed());
        // It is of use again, and not only there.
        crowd.await_grants(CLIENTS).await.with_context(|| format!("after crash {crash}: {}", manager.said()))?;
    }
    let shared = crowd.end().await?;
    let (grants, repeated) = told(&shared, |told| (told.grants, told.repeated));
    println!("{grants} grants, {repeated} answers by asking again, back within {} ms", slowest.as_millis());
    ensure!(repeated > 0, "no kill came in between");
    Ok(())
}
