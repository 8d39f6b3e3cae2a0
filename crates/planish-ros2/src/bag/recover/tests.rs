use std::io::Cursor;

use super::*;

#[test]
fn a_cut_message_stays_cut_if_recovery_is_killed_after_it_reserved_space() {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = mcap::WriteOptions::new().use_chunks(false).create(&mut bytes).unwrap();
    let channel = writer.add_channel(0, "topic", "raw", &BTreeMap::new()).unwrap();
    for sequence in 0..2 {
        let header = mcap::records::MessageHeader { channel_id: channel, sequence, log_time: 1, publish_time: 1 };
        writer.write_to_known_channel(&header, &[7; 1000]).unwrap();
    }
    writer.flush().unwrap();
    drop(writer);
    let bytes = bytes.into_inner();
    let last = bytes.windows(1000).rposition(|data| data == [7; 1000]).unwrap();

    let mut file = tempfile::tempfile().unwrap();
    file.write_all(&bytes[..last + 990]).unwrap();
    let length = file.metadata().unwrap().len();
    let options = ReadOptions::default();
    let end = Scan::default().run(&mut file, length, &options).unwrap();
    assert!(end.dropped > 990);
    reserve(&mut file, length, length + 500, Some(end.valid)).unwrap();
    let recovered = complete_in_place(&mut file, &options).unwrap();
    assert_eq!((recovered.messages, recovered.was_whole), (1, false));
}
