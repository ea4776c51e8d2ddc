// Adapter of Fast DDS 2, with ROS 2's default quality of service, for over_fastdds.py, which
// compiles it where Fast DDS is installed.

#include <chrono>
#include <cstdint>
#include <cstring>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/config.h>

namespace fast = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;

namespace {

constexpr std::uint32_t kMostBytes = 1 << 20;
// CDR header, and the payload's length.
constexpr std::uint32_t kHeadBytes = 8;

using Bytes = std::vector<std::uint8_t>;

// A message as a DDS type: a CDR sequence of octets.
class BytesType : public fast::TopicDataType {
 public:
  BytesType() {
    setName("lpac::Bytes");
    m_typeSize = kHeadBytes + kMostBytes;
    m_isGetKeyDefined = false;
  }

  bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
    const Bytes& bytes = *static_cast<Bytes*>(data);
    const auto size = static_cast<std::uint32_t>(bytes.size());
    if (kHeadBytes + size > payload->max_size) return false;
    const std::uint8_t little_endian[4] = {0, 1, 0, 0};
    std::memcpy(payload->data, little_endian, 4);
    std::memcpy(payload->data + 4, &size, 4);
    std::memcpy(payload->data + kHeadBytes, bytes.data(), size);
    payload->encapsulation = CDR_LE;
    payload->length = kHeadBytes + size;
    return true;
  }

  bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
    std::uint32_t size = 0;
    if (payload->length < kHeadBytes) return false;
    std::memcpy(&size, payload->data + 4, 4);
    if (size > payload->length - kHeadBytes) return false;
    const std::uint8_t* begin = payload->data + kHeadBytes;
    static_cast<Bytes*>(data)->assign(begin, begin + size);
    return true;
  }

  std::function<std::uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] {
      return kHeadBytes + static_cast<std::uint32_t>(static_cast<Bytes*>(data)->size());
    };
  }

  void* createData() override { return new Bytes; }
  void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
  bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
};

template <typename Qos>
void as_ros_2(Qos& qos) {
  qos.reliability().kind = fast::RELIABLE_RELIABILITY_QOS;
  qos.reliability().max_blocking_time = eprosima::fastrtps::Duration_t(0, 100000000);
  qos.durability().kind = fast::VOLATILE_DURABILITY_QOS;
  qos.history().kind = fast::KEEP_LAST_HISTORY_QOS;
  qos.history().depth = 10;
  qos.endpoint().history_memory_policy = rtps::DYNAMIC_RESERVE_MEMORY_MODE;
  qos.data_sharing().off();
}

struct Peer {
  fast::DomainParticipant* participant = nullptr;
  fast::DataWriter* writer = nullptr;
  fast::DataReader* reader = nullptr;

  ~Peer() {
    if (participant == nullptr) return;
    participant->delete_contained_entities();
    fast::DomainParticipantFactory::get_instance()->delete_participant(participant);
  }

  bool open(std::uint32_t domain, const std::string& address, const char* const* topics, int count) {
    fast::DomainParticipantQos qos;
    // Shared memory between robots of one computer would bypass the network.
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back(address);
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    participant = fast::DomainParticipantFactory::get_instance()->create_participant(domain, qos);
    if (participant == nullptr) return false;
    fast::TypeSupport type(new BytesType);
    type.register_type(participant);
    fast::Publisher* publisher = participant->create_publisher(fast::PUBLISHER_QOS_DEFAULT);
    fast::Subscriber* subscriber = participant->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT);
    if (publisher == nullptr || subscriber == nullptr) return false;
    // All topics of a robot are declared, as on real robots; only the first is used.
    for (int i = 0; i < count; ++i) {
      fast::Topic* topic =
          participant->create_topic(topics[i], type.get_type_name(), fast::TOPIC_QOS_DEFAULT);
      if (topic == nullptr) return false;
      fast::DataWriterQos writing = fast::DATAWRITER_QOS_DEFAULT;
      as_ros_2(writing);
      fast::DataWriter* of_topic = publisher->create_datawriter(topic, writing);
      if (of_topic == nullptr) return false;
      if (i > 0) continue;
      fast::DataReaderQos reading = fast::DATAREADER_QOS_DEFAULT;
      as_ros_2(reading);
      writer = of_topic;
      reader = subscriber->create_datareader(topic, reading);
    }
    return reader != nullptr;
  }
};

}  // namespace

extern "C" {

const char* fast_dds_version() { return FASTRTPS_VERSION_STR; }

Peer* fast_dds_open(std::uint32_t domain, const char* address, const char* const* topics, int count) {
  auto peer = std::make_unique<Peer>();
  return peer->open(domain, address, topics, count) ? peer.release() : nullptr;
}

void fast_dds_close(Peer* peer) { delete peer; }

int fast_dds_publish(Peer* peer, const std::uint8_t* data, std::uint32_t size) {
  Bytes bytes(data, data + size);
  return peer->writer->write(&bytes) ? 1 : 0;
}

// Size of the next message; 0 after the timeout, -1 if it is larger than `size`.
int fast_dds_take(Peer* peer, std::uint8_t* data, std::uint32_t size, std::uint32_t timeout_ms) {
  const auto until = std::chrono::steady_clock::now() + std::chrono::milliseconds(timeout_ms);
  Bytes bytes;
  fast::SampleInfo info;
  for (;;) {
    while (peer->reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK) {
      // Otherwise the sample announces the end of a writer.
      if (!info.valid_data) continue;
      if (bytes.size() > size) return -1;
      std::memcpy(data, bytes.data(), bytes.size());
      return static_cast<int>(bytes.size());
    }
    const auto left = until - std::chrono::steady_clock::now();
    const auto left_ms = std::chrono::duration_cast<std::chrono::milliseconds>(left).count();
    if (left_ms <= 0) return 0;
    peer->reader->wait_for_unread_message(
        eprosima::fastrtps::Duration_t(static_cast<int>(left_ms / 1000),
                                       static_cast<std::uint32_t>(left_ms % 1000) * 1000000));
  }
}
}
