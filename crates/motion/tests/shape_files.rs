//! Files with shapes and points: what other writers make is read as its format says, and what cannot be read is refused with the place.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_motion::inside::Inside;
use ratn_motion::mesh::Mesh;
use ratn_motion::point_files;

type Triangle = [[f64; 3]; 3];

fn volume(mesh: &Mesh) -> f64 {
    let of = |[a, b, c]: &Triangle| {
        let cross = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
        (0..3).map(|i| a[i] * cross[i]).sum::<f64>() / 6.0
    };
    mesh.triangles().iter().map(of).sum()
}

fn area(mesh: &Mesh) -> f64 {
    let of = |[a, b, c]: &Triangle| {
        let (u, v): ([f64; 3], [f64; 3]) = (std::array::from_fn(|i| b[i] - a[i]), std::array::from_fn(|i| c[i] - a[i]));
        let cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        cross.iter().map(|c| c * c).sum::<f64>().sqrt() / 2.0
    };
    mesh.triangles().iter().map(of).sum()
}

fn mesh(name: &str, text: &str) -> Result<Mesh, String> {
    Mesh::read(name, text.as_bytes(), [1.0; 3]).map_err(|error| error.to_string())
}

fn points(name: &str, bytes: &[u8]) -> Result<Vec<[f32; 3]>, String> {
    point_files::points(name, bytes).map_err(|error| error.to_string())
}

/// A Collada file: `faces` over the corners of a cube from 0 to 2, in a scene with `nodes`; `library` for more.
fn collada(asset: &str, faces: &str, library: &str, nodes: &str) -> String {
    let corners = (0..8).map(|i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 0 { "0" } else { "2" }).join(" "));
    format!(
        "<COLLADA version='1.4.1'><asset>{asset}</asset><library_geometries><geometry id='g'><mesh><source id='s'>\
         <float_array id='a' count='24'>{}</float_array><technique_common><accessor source='#a' count='8' stride='3'>\
         <param name='X' type='float'/><param name='Y' type='float'/><param name='Z' type='float'/></accessor></technique_common>\
         </source><vertices id='v'><input semantic='POSITION' source='#s'/></vertices>{faces}</mesh></geometry></library_geometries>\
         <library_nodes>{library}</library_nodes><library_visual_scenes><visual_scene id='scene'>{nodes}</visual_scene>\
         </library_visual_scenes><scene><instance_visual_scene url='#scene'/></scene></COLLADA>",
        corners.collect::<Vec<_>>().join(" ")
    )
}

const CUBE: &str = "0 2 3 1 4 5 7 6 0 1 5 4 2 6 7 3 0 4 6 2 1 3 7 5";
const VERTEX: &str = "<input semantic='VERTEX' source='#v' offset='0'/>";
const SHOWN: &str = "<node><instance_geometry url='#g'/></node>";

fn polylist(vcount: &str, p: &str) -> String {
    format!("<polylist count='6'>{VERTEX}{vcount}<p>{p}</p></polylist>")
}

fn cube_with(asset: &str, library: &str, nodes: &str) -> Result<Mesh, String> {
    mesh("a.dae", &collada(asset, &polylist("<vcount>4 4 4 4 4 4</vcount>", CUBE), library, nodes))
}

#[test]
fn a_fan_of_instances_in_collada_is_refused_with_the_bound() {
    // Each level shows the next one twice: 2^40 instances in 4 kB.
    let level =
        |i: usize| format!("<node id='n{i}'><instance_node url='#n{0}'/><instance_node url='#n{0}'/></node>", i + 1);
    let fan: String = (0..40).map(level).collect();
    for last in ["<node id='n40'/>", "<node id='n40'><instance_geometry url='#g'/></node>"] {
        let refused = cube_with("", &(fan.clone() + last), "<node><instance_node url='#n0'/></node>").unwrap_err();
        assert!(refused.contains("nodes") || refused.contains("triangles"), "{refused}");
        assert!(refused.contains("100000"), "{refused}");
    }
    // One level of it is what writers make of a part that is there twice.
    let twice = "<node id='n0'><instance_node url='#n1'/><node><translate>5 0 0</translate><instance_node url='#n1'/></node></node>\
                 <node id='n1'><instance_geometry url='#g'/></node>";
    let read = cube_with("", twice, "<node><instance_node url='#n0'/></node>").unwrap();
    assert_eq!((read.triangles().len(), volume(&read).round()), (24, 16.0));
}

#[test]
fn numbers_in_collada_are_looked_at_before_they_are_used() {
    let faces = polylist("<vcount>4 4 4 4 4 4</vcount>", CUBE);
    let with = |from: &str, to: &str| mesh("a.dae", &collada("", &faces, "", SHOWN).replace(from, to)).unwrap_err();
    for offset in ["18446744073709551615", "18446744073709551614", "9223372036854775807", "4294967295"] {
        let refused = with("offset='0'", &format!("offset='{offset}'"));
        assert!(refused.contains("offset") && refused.contains(offset), "{refused}");
        let refused = with("stride='3'", &format!("stride='{offset}'"));
        assert!(refused.contains("stride"), "{refused}");
        let refused = with("<vcount>4", &format!("<vcount>{offset}"));
        assert!(refused.contains("ends too early"), "{refused}");
        let refused = with("count='8'", &format!("count='{offset}'"));
        assert!(refused.contains("numbers"), "{refused}");
    }
    for unit in ["0", "-1", "nan", "inf", "1e-400", "m"] {
        let refused = cube_with(&format!("<unit meter='{unit}'/>"), "", SHOWN).unwrap_err();
        assert!(refused.contains("`meter`"), "{refused}");
    }
    let fine = cube_with("<unit name='inch' meter='0.0254'/><up_axis>Y_UP</up_axis>", "", SHOWN).unwrap();
    assert!((volume(&fine) - 8.0 * 0.0254_f64.powi(3)).abs() < 1e-12);
    // As in ROS the axes are those of the file, also with the y axis up.
    assert!(fine.triangles().iter().flatten().flatten().all(|c| *c == 0.0 || *c == 2.0 * 0.0254));
}

#[test]
fn collada_faces_that_are_not_whole_are_refused() {
    let refused = |faces: &str| mesh("a.dae", &collada("", faces, "", SHOWN)).unwrap_err();
    assert!(refused(&polylist("", CUBE)).contains("`vcount`"));
    // Corners that belong to no face.
    assert!(refused(&polylist("<vcount>4 4 4 4 4</vcount>", CUBE)).contains("`polylist`"));
    assert!(refused(&format!("<triangles count='1'>{VERTEX}<p>0 1 2 3</p></triangles>")).contains("`triangles`"));
    assert!(refused(&format!("<triangles count='2'>{VERTEX}<p>0 1 2</p></triangles>")).contains("`count`"));
    let hole = format!("<polygons count='1'>{VERTEX}<ph><p>0 1 3 2</p><h>4 5 7</h></ph></polygons>");
    assert!(refused(&hole).contains("holes"), "{}", refused(&hole));
    let ragged = "<polygons count='1'><input semantic='VERTEX' source='#v' offset='0'/><input semantic='NORMAL' source='#n' offset='1'/>\
                  <p>0 0 1 0 3 0 2</p></polygons>";
    assert!(refused(ragged).contains("`polygons`"));
    let polygons: String =
        ["0 2 3 1", "4 5 7 6", "0 1 5 4", "2 6 7 3", "0 4 6 2", "1 3 7 5"].map(|p| format!("<p>{p}</p>")).concat();
    let whole =
        mesh("a.dae", &collada("", &format!("<polygons count='6'>{VERTEX}{polygons}</polygons>"), "", SHOWN)).unwrap();
    assert_eq!((whole.triangles().len(), volume(&whole).round()), (12, 8.0));
    // Triangles without any, as exporters write for materials that nothing has.
    let empty = format!("{}<triangles count='0'>{VERTEX}</triangles>", polylist("<vcount>4 4 4 4 4 4</vcount>", CUBE));
    assert_eq!(mesh("a.dae", &collada("", &empty, "", SHOWN)).unwrap().triangles().len(), 12);
}

#[test]
fn collada_positions_are_where_their_accessor_says() {
    let faces = polylist("<vcount>4 4 4 4 4 4</vcount>", CUBE);
    let plain = collada("", &faces, "", SHOWN);
    // Two numbers before the first position, and one that is not named after each.
    let corners =
        (0..8).map(|i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 0 { "0" } else { "2" }).join(" ") + " 77");
    let array = format!("count='34'>9 9 {}<", corners.collect::<Vec<_>>().join(" "));
    let start = plain.find("count='24'>").unwrap();
    let end = start + plain[start..].find('<').unwrap() + 1;
    let mut moved = plain.clone();
    moved.replace_range(start..end, &array);
    let moved = moved.replace("count='8' stride='3'", "count='8' offset='2' stride='4'");
    assert_eq!(mesh("a.dae", &moved).unwrap(), mesh("a.dae", &plain).unwrap());
    // Without the third name there is no third coordinate.
    let flat = plain.replace("<param name='Z' type='float'/>", "<param type='float'/>");
    assert!(mesh("a.dae", &flat).unwrap_err().contains("three coordinates"));
}

#[test]
fn faces_with_reentrant_corners_are_cut_within_their_outline() {
    // A prism over an L of area 3; its reentrant corner is the fourth, so that cutting from the first leaves the outline.
    let outline = [[1, 2], [0, 2], [0, 0], [2, 0], [2, 1], [1, 1]];
    let mut text = String::new();
    for z in [0, 1] {
        outline.iter().for_each(|[x, y]| text += &format!("v {x} {y} {z}\n"));
    }
    text += "f 6 5 4 3 2 1\nf -6 -5 -4 -3 -2 -1\n";
    (0..6).for_each(|i| text += &format!("f {} {} {} {}\n", i + 1, (i + 1) % 6 + 1, (i + 1) % 6 + 7, i + 7));
    let read = mesh("a.obj", &text).unwrap();
    assert_eq!(read.triangles().len(), 20);
    assert!((area(&read) - 14.0).abs() < 1e-12 && (volume(&read) - 3.0).abs() < 1e-12);
    // A dart: a quad with a reentrant corner, in all its four writings.
    for shift in 0..4 {
        let corners: Vec<String> = (0..4).map(|i| ((i + shift) % 4 + 1).to_string()).collect();
        let dart = format!("v 0 0 0\nv 2 -1 0\nv 1 0 0\nv 2 1 0\nf {}\n", corners.join(" "));
        assert_eq!(area(&mesh("a.obj", &dart).unwrap()), 1.0, "{shift}");
    }
}

#[test]
fn an_stl_in_text_is_whole_or_refused() {
    let facet = |c: [&str; 3]| {
        format!(
            "facet normal 0 0 1\nouter loop\nvertex {}\nvertex {}\nvertex {}\nendloop\nendfacet\n",
            c[0], c[1], c[2]
        )
    };
    let (first, second) = (facet(["0 0 0", "1 0 0", "0 1 0"]), facet(["0 0 1", "1 0 1", "0 1 1.125"]));
    let whole = format!("solid two parts\n{first}{second}endsolid two parts\n");
    assert_eq!(mesh("a.stl", &whole).unwrap().triangles().len(), 2);
    // Keywords in capitals, without a name, with the line ends of Windows; two solids in one file.
    let capitals = whole.to_uppercase().replace("\n", "\r\n").replace("ENDSOLID TWO PARTS", "ENDSOLID");
    assert_eq!(mesh("a.stl", &capitals).unwrap(), mesh("a.stl", &whole).unwrap());
    assert_eq!(
        mesh("a.stl", &format!("solid a\n{first}endsolid a\nsolid b\n{second}endsolid b")).unwrap().triangles().len(),
        2
    );
    let last = whole.rfind("endsolid").unwrap();
    for end in 0..last + 8 {
        let refused = mesh("a.stl", &whole[..end]);
        assert!(refused.is_err(), "cut at {end}: {} triangles", refused.unwrap().triangles().len());
    }
    let cut = mesh("a.stl", &whole[..last]).unwrap_err();
    assert!(cut.contains("line 15") && cut.contains("`endsolid`"), "{cut}");
    assert!(mesh("a.stl", &whole.replacen("endfacet\n", "", 1)).is_err());
}

#[test]
fn a_scale_mirrors_and_none_is_refused() {
    let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    for (scale, expected) in
        [([1.0; 3], 1.0), ([-1.0, 1.0, 1.0], 1.0), ([-2.0, -1.0, -1.0], 2.0), ([-1.0, -1.0, 3.0], 3.0)]
    {
        let read = Mesh::read("a.obj", text.as_bytes(), scale).unwrap();
        assert!((volume(&read) * 6.0 - expected).abs() < 1e-12, "{scale:?}");
        let inside = Inside::new(&read);
        assert!(inside.contains(scale.map(|s| 0.2 * s)) && !inside.contains(scale.map(|s| -0.2 * s)), "{scale:?}");
    }
    for scale in [[0.0, 1.0, 1.0], [1.0, f64::NAN, 1.0], [1.0, 1.0, f64::INFINITY]] {
        let refused = Mesh::read("a.obj", text.as_bytes(), scale).unwrap_err().to_string();
        assert!(refused.contains("scale"), "{refused}");
    }
    let cube = |steps: &str| cube_with("", "", &format!("<node>{steps}<instance_geometry url='#g'/></node>")).unwrap();
    assert_eq!(volume(&cube("<scale>-1 1 1</scale>")).round(), 8.0);
    assert_eq!(volume(&cube("<scale>-1 -1 1</scale>")).round(), 8.0);
}

const EXPECTED: [[f32; 3]; 2] = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];

#[test]
fn ply_properties_are_read_by_their_names() {
    let header = |format: &str, rest: &str| {
        format!("ply\r\nformat {format} 1.0\r\ncomment element vertex 7\r\n{rest}end_header\r\n")
    };
    for (properties, body) in [
        (
            "element vertex 2\nproperty float nx\nproperty float x\nproperty float y\nproperty float z\n",
            "9 1 2 3\n9 4 5 6\n",
        ),
        (
            "element vertex 2\nproperty double z\nproperty double y\nproperty uchar red\nproperty float x\n",
            "3 2 255 1\n6 5 0 4\n",
        ),
        (
            "element camera 1\nproperty float f\nelement vertex 2\nproperty list uchar int near\nproperty float x\nproperty float y\nproperty float z\n\
          element face 1\nproperty list uchar int vertex_indices\n",
            "0.5\n2 7 7 1 2 3\n0 4 5 6\n3 0 1 1\n",
        ),
        (
            "element face 2\nproperty list uchar int i\nelement vertex 3\nproperty int x\nproperty int y\nproperty float z\n",
            "3 0 1 2\n3 2 1 0\n1 2 3\n4 5 nan\n4 5 6\n",
        ),
    ] {
        let text = header("ascii", properties) + body;
        assert_eq!(points("a.ply", text.as_bytes()).as_deref(), Ok(&EXPECTED[..]), "{text}");
        let cut = text.trim_end().rsplit_once('\n').unwrap().0;
        // The last line is a face in one of them: all points are there.
        assert_eq!(points("a.ply", cut.as_bytes()).is_err(), !properties.contains("camera"), "{text}");
    }
    let properties = "element face 1\nproperty list uchar ushort i\nelement vertex 2\nproperty uchar red\nproperty double y\nproperty float x\n\
                      property list short float near\nproperty short z\n";
    for big in [false, true] {
        let mut file = header(if big { "binary_big_endian" } else { "binary_little_endian" }, properties).into_bytes();
        let mut put = |bytes: &[u8]| {
            let turned: Vec<u8> = if big { bytes.iter().rev().copied().collect() } else { bytes.to_vec() };
            file.extend(turned);
        };
        put(&[2]);
        put(&7_u16.to_le_bytes());
        put(&8_u16.to_le_bytes());
        for [x, y, z] in EXPECTED {
            put(&[10]);
            put(&f64::from(y).to_le_bytes());
            put(&x.to_le_bytes());
            put(&1_i16.to_le_bytes());
            put(&0.5_f32.to_le_bytes());
            put(&(z as i16).to_le_bytes());
        }
        assert_eq!(points("a.ply", &file).as_deref(), Ok(&EXPECTED[..]));
        for end in 0..file.len() {
            assert!(points("a.ply", &file[..end]).is_err(), "cut at {end}");
        }
    }
    let refused = |rest: &str| points("a.ply", (header("ascii", rest) + "1 2 3\n").as_bytes()).unwrap_err();
    assert!(refused("element vertex 1\nproperty float x\nproperty float y\n").contains("`z`"));
    assert!(
        refused("element vertex 99999999999\nproperty float x\nproperty float y\nproperty float z\n")
            .contains("4000000")
    );
    assert!(
        refused("element vertex 1\nproperty float x\nproperty float y\nproperty list uchar float z\n").contains("`z`")
    );
    assert!(refused("element vertex 1\nproperty quad x\n").contains("quad"));
    assert!(refused("element face 1\nproperty list uchar int i\n").contains("vertex"));
    assert!(points("a.ply", b"ply\nformat binary 1.0\nend_header\n").unwrap_err().contains("line 2"));
}

#[test]
fn pcd_fields_are_read_by_their_names() {
    let header = |fields: &str, data: &str| format!("# .PCD v.7\nVERSION .7\n{fields}VIEWPOINT 0 0 0 1 0 0 0\n{data}");
    let plain = "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n";
    let mixed = "FIELDS normal z x _ y\nSIZE 4 8 4 1 2\nTYPE F F F U I\nCOUNT 3 1 1 2 1\nWIDTH 1\nHEIGHT 2\nPOINTS 2\n";
    for (fields, body) in [(plain, "1 2 3 7\n4 5 6 7\n"), (mixed, "0 0 1 3 1 0 0 2\n0 0 1 6 4 0 0 5\n")] {
        let text = header(fields, "DATA ascii\n") + body;
        assert_eq!(points("a.pcd", text.as_bytes()).as_deref(), Ok(&EXPECTED[..]), "{text}");
        let cut = text.trim_end().rsplit_once('\n').unwrap().0;
        assert!(points("a.pcd", cut.as_bytes()).unwrap_err().contains("2 points"), "{text}");
        assert!(points("a.pcd", (text + "7 8 9 0\n").as_bytes()).is_err());
    }
    // In binary the records follow each other; compressed, the fields do.
    let record = |[x, y, z]: [f32; 3]| -> [Vec<u8>; 5] {
        [
            vec![9; 12],
            f64::from(z).to_le_bytes().to_vec(),
            x.to_le_bytes().to_vec(),
            vec![9; 2],
            (y as i16).to_le_bytes().to_vec(),
        ]
    };
    let mut file = header(mixed, "DATA binary\n").into_bytes();
    EXPECTED.iter().for_each(|point| file.extend(record(*point).concat()));
    let columns: Vec<u8> =
        (0..5).flat_map(|i| EXPECTED.iter().flat_map(move |point| record(*point)[i].clone())).collect();
    let mut packed = header(mixed, "DATA binary_compressed\n").into_bytes();
    // By the format of LZF: one byte, a reference of 23 bytes to it, then the others as they are, 32 at a time.
    let mut stream = vec![0, columns[0], 7 << 5, 23 - 2 - 7, 0];
    columns[24..].chunks(32).for_each(|chunk| {
        stream.push(chunk.len() as u8 - 1);
        stream.extend(chunk);
    });
    packed.extend((stream.len() as u32).to_le_bytes());
    packed.extend((columns.len() as u32).to_le_bytes());
    packed.extend(stream);
    for file in [file, packed] {
        assert_eq!(points("a.pcd", &file).as_deref(), Ok(&EXPECTED[..]));
        for end in 0..file.len() {
            assert!(points("a.pcd", &file[..end]).is_err(), "cut at {end}");
        }
    }
    let refused = |fields: &str| points("a.pcd", (header(fields, "DATA ascii\n") + "1 2 3\n").as_bytes()).unwrap_err();
    assert!(refused("FIELDS x y z\nCOUNT 1 1 1\n").contains("POINTS"));
    assert!(refused("FIELDS x y\nPOINTS 1\n").contains("`z`"));
    assert!(refused("FIELDS x y z\nPOINTS 3\nWIDTH 1\nHEIGHT 1\n").contains("WIDTH"));
    assert!(refused("FIELDS x y z\nCOUNT 1 1\nPOINTS 1\n").contains("COUNT"));
    assert!(refused("FIELDS x y z\nPOINTS 99999999999\n").contains("4000000"));
    assert!(points("a.pcd", b"FIELDS x y z\nPOINTS 1\nDATA zip\n").unwrap_err().contains("zip"));
}

#[test]
fn columns_of_points_are_not_taken_for_each_other() {
    for (name, text) in [
        ("a.xyz", "1 2 3 255\n4\t5   6 0\n"),
        ("a.csv", "1, 2, 3, red\r\n4 ,5,6,\r\n"),
        ("a.txt", "# x y z\n1;2;3\n\n4; 5; 6\n"),
    ] {
        let read = points(name, text.as_bytes()).map(|all| all[..2].to_vec());
        assert_eq!(read.as_deref(), Ok(&EXPECTED[..]), "{name}");
    }
    // A field that is left out, and decimal commas.
    assert_eq!(points("a.csv", b"1,2,3\n1,,3,255\n").unwrap_err(), "line 2: a point has three numbers");
    assert_eq!(points("a.csv", b"1,5;2,5;3,5\n").unwrap_err(), "line 1: a point has three numbers");
    assert!(points("a.xyz", b"1 2 3\n4 5").is_err());
}

#[test]
fn entities_of_a_document_type_are_refused() {
    let plain = collada("", &polylist("<vcount>4 4 4 4 4 4</vcount>", CUBE), "", SHOWN);
    let entities = "<!DOCTYPE COLLADA [<!ENTITY a '1 2 3 4 5 6 7 8'><!ENTITY b '&a;&a;&a;&a;'>]>\n";
    let refused = mesh("a.dae", &format!("<?xml version='1.0'?>\n{entities}{plain}")).unwrap_err();
    assert!(refused.contains("line 3") && refused.contains("DOCTYPE"), "{refused}");
    // In the attributes of the outermost element, too.
    let long = format!("<!DOCTYPE COLLADA [<!ENTITY a '{}'>]>\n", "x".repeat(1 << 18));
    let root = plain.replacen("version='1.4.1'", &format!("version='{}'", "&a;".repeat(64)), 1);
    let refused = mesh("a.dae", &format!("{long}{root}")).unwrap_err();
    assert!(refused.contains("attribute") || refused.contains("DOCTYPE"), "{refused}");
}

#[test]
fn a_collada_accessor_names_an_array_that_is_there() {
    let plain = collada("", &polylist("<vcount>4 4 4 4 4 4</vcount>", CUBE), "", SHOWN);
    assert!(mesh("a.dae", &plain).is_ok());
    let refused = mesh("a.dae", &plain.replace("accessor source='#a'", "accessor source='#b'")).unwrap_err();
    assert!(refused.contains("`b`"), "{refused}");
    let refused = mesh("a.dae", &plain.replace("accessor source='#a'", "accessor")).unwrap_err();
    assert!(refused.contains("`accessor`") && refused.contains("`source`"), "{refused}");
}

/// `count` geometries whose sources all read one array of `numbers` numbers.
fn shared_array(count: usize, numbers: usize) -> String {
    let array = vec!["1"; numbers].join(" ");
    let geometry = |i: usize| {
        format!(
            "<geometry id='g{i}'><mesh><source id='s{i}'><technique_common><accessor source='#a' count='{}' stride='3'/>\
             </technique_common></source><vertices id='v{i}'><input semantic='POSITION' source='#s{i}'/></vertices>\
             <triangles><input semantic='VERTEX' source='#v{i}' offset='0'/><p>0 1 2</p></triangles></mesh></geometry>",
            numbers / 3
        )
    };
    let all: String = (0..count).map(geometry).collect();
    format!(
        "<COLLADA><library_geometries>{all}<source><float_array id='a'>{array}</float_array></source></library_geometries></COLLADA>"
    )
}

#[test]
fn sources_that_share_a_long_array_are_bounded() {
    assert_eq!(mesh("a.dae", &shared_array(3, 30_000)).unwrap().triangles().len(), 3);
    let refused = mesh("a.dae", &shared_array(400, 30_000)).unwrap_err();
    assert!(refused.contains("positions") && refused.contains("3000000"), "{refused}");
}

#[test]
fn a_line_of_an_obj_goes_on_after_a_backslash() {
    let corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";
    let all = mesh("a.obj", &format!("{corners}f 1//1 2//1 3//1 4//1\n")).unwrap();
    for face in ["f 1//1 2//1 \\\n3//1 4//1\n", "f 1//1 2//1 3//1\\\n 4//1\n", "f 1//1 2//1 \\\r\n  3//1 \\\r\n 4//1"] {
        assert_eq!(mesh("a.obj", &format!("{corners}{face}")).as_ref(), Ok(&all), "{face}");
    }
    // Whether a number goes on cannot be told.
    let refused = mesh("a.obj", &format!("{corners}f 1//1 2//1 3//1\\\n4//1\n")).unwrap_err();
    assert!(refused.contains("line 5") && refused.contains('\\'), "{refused}");
    let refused = mesh("a.obj", &format!("{corners}f 1 2 3 \\")).unwrap_err();
    assert!(refused.contains("line 5") && refused.contains("cut off"), "{refused}");
    // Lines are counted as in the file.
    let refused = mesh("a.obj", &format!("{corners}f 1 \\\n 2 3\nf 1 2 9\n")).unwrap_err();
    assert!(refused.contains("line 7"), "{refused}");
}

#[test]
fn a_facet_on_the_line_of_its_solid_is_refused() {
    let facet = "facet normal 0 0 1 outer loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n";
    let whole = format!("solid a\n{facet}{facet}endsolid a\n");
    assert_eq!(mesh("a.stl", &whole).unwrap().triangles().len(), 2);
    let joined = facet.replace('\n', " ");
    let refused = mesh("a.stl", &format!("solid a {joined}\n{facet}endsolid a\n")).unwrap_err();
    assert!(refused.contains("line 1") && refused.contains("`facet`"), "{refused}");
}

#[test]
fn a_list_of_points_that_was_cut_within_its_last_line_is_refused() {
    let whole = "1 2 3 255 0 0\n4 5 6 0 255 0\n";
    assert_eq!(points("a.xyz", whole.as_bytes()).as_deref(), Ok(&EXPECTED[..]));
    assert_eq!(points("a.xyz", whole.trim_end().as_bytes()).as_deref(), Ok(&EXPECTED[..]));
    for end in ["4 5 6", "4 5 6 0", "4 5 6 0 255"] {
        let refused = points("a.xyz", format!("1 2 3 255 0 0\n{end}").as_bytes()).unwrap_err();
        assert!(refused.contains("line 2") && refused.contains("cut off"), "{refused}");
    }
    // A number that ends early cannot be told from a whole one, nor a file that ends with a line.
    assert!(points("a.xyz", b"1 2 3\n4 5 6.2").is_ok());
    // Of a line that ends, more or fewer columns behind the point say nothing.
    assert!(points("a.xyz", b"1 2 3 255\n4 5 6\n").is_ok());
}

#[test]
fn heights_with_empty_fields_decimal_commas_or_values_above_the_greatest_are_refused() {
    use ratn_motion::heightfield::Heights;
    let heights = |bytes: &[u8]| Heights::read(bytes, 1.0).map_err(|error| error.to_string());
    let plain = heights(b"1 2 3\n4 5 6\n").unwrap();
    for same in
        ["1,2,3\n4,5,6\n", "1; 2 ;3\n4;5;6", "1\t2  3\r\n4 5 6\r\n", "# heights\n 1, 2, 3\n\n4, 5, 6 # the last\n"]
    {
        assert_eq!(heights(same.as_bytes()).as_ref(), Ok(&plain), "{same}");
    }
    for (wrong, parts) in [
        ("1,2,3\n4,,6\n", &["line 2", "field 2", "empty"][..]),
        ("1,2,3\n4,5,\n", &["line 2", "field 3", "empty"]),
        (",1,2\n,4,5\n", &["line 1", "field 1", "empty"]),
        ("1;;3\n4;5;6\n", &["line 1", "field 2", "empty"]),
        ("1,5;2,5\n3,5;4,5\n", &["line 1", "`1,5`", "comma"]),
        ("1,5 2,5\n3,5 4,5\n", &["line 1", "comma"]),
        ("1 2,3\n4 5,6\n", &["line 1", "`1 2`"]),
    ] {
        let refused = heights(wrong.as_bytes()).unwrap_err();
        assert!(parts.iter().all(|part| refused.contains(part)), "{wrong}: {refused}");
    }
    let grey = |most: &str, values: &[u8]| [format!("P5\n2 2\n{most}\n").as_bytes(), values].concat();
    assert!(heights(&grey("100", &[0, 50, 99, 100])).is_ok());
    for refused in [
        heights(&grey("100", &[0, 50, 101, 7])),
        heights(b"P2 2 2 100\n0 50\n101 7\n"),
        heights(&grey("300", &[0, 1, 1, 45, 1, 44, 0, 0])),
    ] {
        let refused = refused.unwrap_err();
        assert!(refused.contains("101") || refused.contains("301"), "{refused}");
        assert!(refused.contains("at byte") && refused.contains("greatest"), "{refused}");
    }
}

/// Two triangles per side.
fn block(least: [f64; 3], greatest: [f64; 3]) -> Vec<Triangle> {
    let corner = |i: usize| std::array::from_fn(|axis| if i >> axis & 1 == 0 { least[axis] } else { greatest[axis] });
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    sides.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).map(|t| t.map(corner)).collect()
}

fn turned(triangles: &[Triangle]) -> Vec<Triangle> {
    triangles.iter().map(|[a, b, c]| [*a, *c, *b]).collect()
}

fn inside(parts: &[Vec<Triangle>]) -> Inside {
    Inside::new(&Mesh::new(parts.concat()).unwrap())
}

#[test]
fn bodies_that_touch_along_an_edge_are_solid_each_by_itself() {
    let (first, second) = (block([0.0; 3], [2.0; 3]), block([2.0, 2.0, 0.0], [4.0, 4.0, 2.0]));
    // A third overlaps the second.
    let third = block([3.0, 3.0, 0.5], [5.0, 5.0, 1.5]);
    let some = second[..3].to_vec();
    let cases = [
        vec![first.clone(), second.clone(), third.clone()],
        vec![first.clone(), turned(&second), third.clone()],
        vec![turned(&first), second.clone(), turned(&third)],
        // Triangles from both sides, and twice.
        vec![first.clone(), second.clone(), turned(&some), third.clone()],
        vec![first.clone(), second.clone(), some, third.clone()],
    ];
    for (case, parts) in cases.iter().enumerate() {
        let all = inside(parts);
        for at in [[1.0, 1.0, 1.1], [2.5, 2.5, 0.9], [3.5, 3.6, 1.0], [4.5, 4.4, 1.0], [3.2, 3.1, 0.2]] {
            assert!(all.contains(at), "case {case}: {at:?}");
        }
        for at in [[1.0, 3.0, 1.0], [3.0, 1.0, 1.0], [4.5, 4.4, 0.2]] {
            assert!(!all.contains(at), "case {case}: {at:?}");
        }
    }
    // What is open has no inside, and takes nothing from the body beside it.
    let all = inside(&[first, second[..second.len() - 1].to_vec()]);
    assert!(all.contains([1.0, 1.0, 1.1]) && !all.contains([2.5, 2.5, 0.9]));
}

#[test]
fn a_part_that_stands_out_between_its_corners_is_no_hollow() {
    // A dish, thick at its rim and thin in the middle, and a plate that is turned the other way and goes through it there.
    let rim = [[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]];
    let mut dish = Vec::new();
    for i in 0..4 {
        let ([a, b], [c, d]) = (rim[i], rim[(i + 1) % 4]);
        dish.push([[a, b, 1.0], [c, d, 1.0], [0.3, 0.1, 0.05]]);
        dish.push([[a, b, -1.0], [0.3, 0.1, -0.05], [c, d, -1.0]]);
        dish.extend([[[a, b, -1.0], [c, d, -1.0], [c, d, 1.0]], [[a, b, -1.0], [c, d, 1.0], [a, b, 1.0]]]);
    }
    let plate = |half: f64| turned(&block([-1.4, -1.4, -half], [1.4, 1.4, half]));
    assert!(!inside(&[dish.clone(), plate(0.02)]).contains([0.9, 0.7, 0.0]), "a hollow within the dish");
    for at in [[0.3, 0.1, 0.08], [0.9, 0.7, 0.0]] {
        assert!(inside(&[dish.clone(), plate(0.1)]).contains(at), "{at:?} is in the plate that goes through the dish");
    }
}

#[test]
#[allow(clippy::disallowed_methods, reason = "what takes long is noticed by the clock")]
fn many_parts_above_one_another_are_one_column_after_another() {
    const PARTS: usize = 80_000;
    let part = |i: usize| block([0.0, 0.0, i as f64 * 1e-2], [1.0, 1.0, i as f64 * 1e-2 + 5e-3]);
    let stack = inside(&(0..PARTS).map(part).collect::<Vec<_>>());
    let start = std::time::Instant::now();
    assert_eq!(stack.column(0.3, 0.4).len(), PARTS);
    assert!(start.elapsed().as_secs_f64() < 1.0, "{:?}", start.elapsed());
}
