//! Small files of every format, cut and changed at random: reading them neither panics nor takes long, and takes memory in proportion to the
//! file. Nor do many small obstacles take memory out of proportion.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]
#![allow(clippy::disallowed_methods, reason = "what hangs is noticed by the clock")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::cloud::Cloud;
use ratn_motion::exact::Exact;
use ratn_motion::inside::Inside;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::mesh::Mesh;
use ratn_motion::point_files;
use ratn_motion::problems::Problems;
use ratn_motion::space::Space;
use ratn_motion::surroundings::MeshObstacle;
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Files of each format that are made.
const CASES: usize = 600;

/// What reading may hold at once, per byte of the file and besides. An element of Collada is the dearest: four bytes make some 150; and the
/// inside of a mesh has a grid.
const BYTES_PER_BYTE: usize = 400;
const BYTES_BESIDES: usize = 4 << 20;

/// What is held, and the most that was.
static HELD: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

struct Counting;

#[allow(unsafe_code, reason = "an allocator is unsafe; this one counts and leaves the rest to the system's")]
// SAFETY: every call is passed on as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let held = HELD.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        MOST.fetch_max(held, Ordering::Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

const NUMBERS: [&str; 16] = [
    "0",
    "-1",
    "1",
    "3",
    "255",
    "65535",
    "4294967295",
    "4294967296",
    "9223372036854775807",
    "18446744073709551615",
    "18446744073709551616",
    "nan",
    "inf",
    "1e308",
    "-1e-320",
    "x",
];

fn collada() -> Vec<u8> {
    let corners = "0 0 0 1 0 0 0 1 0 1 1 0 0 0 1 1 0 1 0 1 1 1 1 1";
    format!(
        "<COLLADA><asset><unit meter='0.01'/></asset><library_geometries><geometry id='g'><mesh><source id='s'>\
         <float_array id='a' count='24'>{corners}</float_array><technique_common><accessor source='#a' count='8' offset='0' stride='3'>\
         <param name='X'/><param name='Y'/><param name='Z'/></accessor></technique_common></source>\
         <vertices id='v'><input semantic='POSITION' source='#s'/></vertices>\
         <triangles count='2'><input semantic='VERTEX' source='#v' offset='0'/><input semantic='NORMAL' source='#n' offset='1'/><p>0 0 1 0 2 0 1 0 3 0 2 0</p></triangles>\
         <polylist count='3'><input semantic='VERTEX' source='#v' offset='0'/><vcount>4 3 3</vcount><p>0 1 5 4 1 3 2 1 2 0</p></polylist>\
         <polygons count='1'><input semantic='VERTEX' source='#v' offset='0'/><p>4 5 7 6</p></polygons></mesh></geometry></library_geometries>\
         <library_nodes><node id='n'><instance_geometry url='#g'/></node></library_nodes>\
         <library_visual_scenes><visual_scene id='w'><node><matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix><rotate>0 0 1 90</rotate>\
         <instance_node url='#n'/><instance_node url='#n'/></node></visual_scene></library_visual_scenes>\
         <scene><instance_visual_scene url='#w'/></scene></COLLADA>"
    )
    .into_bytes()
}

fn stl() -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes.extend(4_u32.to_le_bytes());
    let corners = [[0.0_f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for triangle in [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] {
        bytes.extend([0; 12]);
        bytes.extend(triangle.iter().flat_map(|i: &usize| corners[*i]).flat_map(f32::to_le_bytes));
        bytes.extend([0; 2]);
    }
    bytes
}

fn pcd(data: &str, body: &[u8]) -> Vec<u8> {
    let header = format!(
        "VERSION .7\nFIELDS x y z n\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 2\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA {data}\n"
    );
    [header.as_bytes(), body].concat()
}

fn ply(format: &str, body: &[u8]) -> Vec<u8> {
    let header = format!(
        "ply\nformat {format} 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
         property list uint uchar near\nend_header\n"
    );
    [header.as_bytes(), body].concat()
}

fn files() -> Vec<(&'static str, Vec<u8>)> {
    let facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n";
    let obj = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0.2 0.1 0\nv 0 1 1\nf 1 2 3 4\nf 1/1 2/2/2 -1//3\nf 1 2 3 4 5\n";
    let record = |c: [f32; 3]| -> Vec<u8> { c.iter().flat_map(|c| c.to_le_bytes()).chain([0; 4]).collect() };
    let records = [record([1.0, 2.0, 3.0]), record([4.0, 5.0, 6.0])].concat();
    let packed = [&[34, 0, 0, 0, 32, 0, 0, 0, 15][..], &records[..16], &[15], &records[16..]].concat();
    let binary = |is_big: bool| {
        let mut body = [&[3][..], &[0; 12]].concat();
        for _ in 0..2 {
            body.extend(
                [1.0_f32, 2.0, 3.0].iter().flat_map(|c| if is_big { c.to_be_bytes() } else { c.to_le_bytes() }),
            );
            body.extend(if is_big { 2_u32.to_be_bytes() } else { 2_u32.to_le_bytes() });
            body.extend([7, 7]);
        }
        body
    };
    vec![
        ("a.stl", stl()),
        ("a.stl", format!("solid a\n{facet}{facet}endsolid a\n").into_bytes()),
        ("a.obj", obj.as_bytes().to_vec()),
        ("a.dae", collada()),
        ("a.xyz", b"1 2 3\n4 5 6 # two\n7 8 9\n".to_vec()),
        ("a.csv", b"1,2,3\n4,5,6\n7,8,9,10\n".to_vec()),
        ("a.pcd", pcd("ascii", b"1 2 3 0 0\n4 5 6 0 0\n")),
        ("a.pcd", pcd("binary", &records)),
        ("a.pcd", pcd("binary_compressed", &packed)),
        ("a.ply", ply("ascii", b"3 0 1 1\n1 2 3 0\n4 5 6 2 7 7\n")),
        ("a.ply", ply("binary_little_endian", &binary(false))),
        ("a.ply", ply("binary_big_endian", &binary(true))),
    ]
}

/// Where the numbers of a file stand, in text.
fn numbers(bytes: &[u8]) -> Vec<(usize, usize)> {
    let is_number = |i: usize| bytes.get(i).is_some_and(|b| b.is_ascii_digit() || *b == b'-' || *b == b'.');
    let first = (0..bytes.len()).filter(|i| is_number(*i) && (*i == 0 || !is_number(i - 1)));
    first.map(|i| (i, (i..).find(|i| !is_number(*i)).unwrap_or(bytes.len()))).collect()
}

fn damaged(random: &mut ChaCha8Rng, whole: &[u8]) -> Vec<u8> {
    let mut bytes = whole.to_vec();
    for _ in 0..random.random_range(1..4) {
        if bytes.is_empty() {
            break;
        }
        let at = random.random_range(0..bytes.len());
        let end = (at + random.random_range(0..40)).min(bytes.len());
        let numbers = numbers(&bytes);
        match random.random_range(0..7) {
            0 => bytes.truncate(at),
            1 => bytes[at] = random.random(),
            2 => bytes[at] ^= 1 << random.random_range(0..8),
            3 => drop(bytes.drain(at..end)),
            4 => {
                let again = bytes[at..end].to_vec();
                let place = random.random_range(0..=bytes.len());
                drop(bytes.splice(place..place, again));
            }
            5 => bytes[at..end.min(at + 4)].fill(0xff),
            _ if numbers.is_empty() => {}
            _ => {
                let (from, to) = numbers[random.random_range(0..numbers.len())];
                drop(bytes.splice(from..to, NUMBERS[random.random_range(0..NUMBERS.len())].bytes()));
            }
        }
    }
    bytes
}

/// Whether it was read.
fn read(name: &str, bytes: &[u8]) -> bool {
    if ["a.stl", "a.obj", "a.dae"].contains(&name) {
        let mesh = Mesh::read(name, bytes, [1.0; 3]);
        // What was read can be used.
        let used = mesh.as_ref().map(|mesh| (Inside::new(mesh).contains([0.3, 0.3, 0.01]), mesh.cover(0.0).len()));
        used.is_ok_and(|(_, spheres)| spheres > 0)
    } else {
        point_files::points(name, bytes).is_ok()
    }
}

/// One test at a time: what is held is counted for all.
static COUNTED: Mutex<()> = Mutex::new(());

/// What making something holds at the most, in bytes.
fn most_held<T>(make: impl FnOnce() -> T) -> usize {
    let held = HELD.load(Ordering::Relaxed);
    MOST.store(held, Ordering::Relaxed);
    drop(make());
    MOST.load(Ordering::Relaxed) - held
}

#[test]
fn many_small_clouds_and_a_mesh_that_stands_there_often_take_little_memory() {
    let _alone = COUNTED.lock();
    let shape = "<collision><origin xyz='0.4 0 0'/><geometry><sphere radius='0.05'/></geometry></collision>";
    let urdf = format!(
        "<robot name='r'><link name='base'/><link name='l'>{shape}</link><joint name='j' type='revolute'><parent link='base'/>\
         <child link='l'/><axis xyz='0 0 1'/><limit lower='-1' upper='1' velocity='1' effort='1'/></joint></robot>"
    );
    let mechanism = Mechanism::read(&urdf, None, &[]).unwrap();
    let at = |i: usize| [0.4 + 1e-4 * i as f32, 0.001 * (i % 7) as f32, 0.2];
    let cloud = |i: usize| Cloud::new("crumb", &[at(i)], 0.01).unwrap();
    let clouds: Vec<Cloud> = (0..300).map(cloud).collect();
    let held = most_held(|| (0..300).map(cloud).collect::<Vec<_>>());
    assert!(held < 1 << 20, "{held} bytes for 300 points");
    let held = most_held(|| Space::new(&mechanism, &clouds[..]));
    assert!(held < 8 << 20, "{held} bytes for 300 points in a space");
    let whole = Cloud::new("all", &(0..300).map(at).collect::<Vec<_>>(), 0.01).unwrap();
    let (mut many, mut one) = (Space::new(&mechanism, &clouds[..]), Space::new(&mechanism, &[whole][..]));
    for i in -50..50 {
        let state = std::array::from_fn(|j| if j == 0 { 0.02 * i as f32 } else { 0.0 });
        assert_eq!(many.is_free(&state), one.is_free(&state), "{state:?}");
    }
    // 2,048 triangles, two hundred times.
    let grid = |x: usize, y: usize| [0.01 * x as f64, 0.01 * y as f64, 0.001 * ((x * y) % 5) as f64];
    let cell = |x: usize, y: usize| {
        let [a, b, c, d] = [grid(x, y), grid(x + 1, y), grid(x + 1, y + 1), grid(x, y + 1)];
        [[a, b, c], [a, c, d]]
    };
    let triangles = (0..1024).flat_map(|i| cell(i % 32, i / 32)).collect();
    let mesh = Arc::new(Mesh::new(triangles).unwrap());
    let obstacle = |i: usize| {
        let pose = Pose::at(5.0 + i as f64, 0.0, 0.0);
        MeshObstacle { name: format!("sheet {i}"), pose, mesh: Arc::clone(&mesh), overhang_m: 0.005 }
    };
    let meshes: Vec<MeshObstacle> = (0..200).map(obstacle).collect();
    let one = most_held(|| Exact::new(&mechanism, &meshes[..1]));
    let all = most_held(|| Exact::new(&mechanism, &meshes[..]));
    assert!(all < 2 * one, "{one} bytes for one, {all} for two hundred");
}

#[test]
fn the_meshes_of_a_problem_count_as_often_as_they_stand_there() {
    let _alone = COUNTED.lock();
    let stl = {
        let mut bytes = vec![b' '; 80];
        bytes.extend(50_000_u32.to_le_bytes());
        bytes.resize(84 + 50_000 * 50, 0);
        bytes
    };
    let problems = |count: usize| {
        let object = r#"{"name": "part", "type": "mesh", "file": "part.stl"}"#;
        let text = format!(
            r#"{{"joints": ["j"], "problems": {{"a": [{{"start": [0], "goal": [1], "objects": [{}]}}]}}}}"#,
            vec![object; count].join(",")
        );
        Problems::parse_with_files(&text, &mut |_| Ok(stl.clone())).map_err(|error| error.to_string())
    };
    assert_eq!(problems(80).unwrap().classes["a"][0].meshes.len(), 80);
    let refused = problems(81).unwrap_err();
    assert!(refused.contains("4050000") && refused.contains("4000000") && refused.contains("`part`"), "{refused}");
}

#[test]
fn a_damaged_file_is_read_or_refused_at_once_and_in_little_memory() {
    let _alone = COUNTED.lock();
    for (format, (name, whole)) in files().into_iter().enumerate() {
        assert!(read(name, &whole), "{name}, format {format}");
        let mut random = ChaCha8Rng::seed_from_u64(format as u64);
        let mut refused = 0;
        for case in 0..CASES {
            let bytes = damaged(&mut random, &whole);
            let shown = || format!("{name}, format {format}, case {case}: {}", String::from_utf8_lossy(&bytes));
            let held = HELD.load(Ordering::Relaxed);
            MOST.store(held, Ordering::Relaxed);
            let start = Instant::now();
            let done = std::panic::catch_unwind(|| read(name, &bytes));
            let (took, most) = (start.elapsed(), MOST.load(Ordering::Relaxed) - held);
            assert!(done.is_ok(), "panics: {}", shown());
            assert!(took < Duration::from_secs(20), "takes {took:?}: {}", shown());
            assert!(most <= BYTES_BESIDES + BYTES_PER_BYTE * bytes.len(), "{most} bytes: {}", shown());
            refused += usize::from(!done.unwrap());
        }
        // Damage that nothing notices shows nothing.
        assert!(refused > CASES / 10 && refused < CASES, "{name}, format {format}: {refused} of {CASES} refused");
    }
}
