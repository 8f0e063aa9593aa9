"""TLS with certificates on both sides, and who may do what by the name in them, all from zenoh's own file."""

import datetime
import ipaddress
import itertools
import json

import pytest
import tiny
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from live_net import Collector, attachment, compiled, free_port, running, until
from test_live_listen import MODEL, message

from streamfeat.live.listen import ListenJob
from streamfeat.live.names import PlainNames
from streamfeat.live.network import Network, open_session

pytestmark = pytest.mark.real_time

RULES = """{
  mode: "peer",
  listen: { endpoints: ["tls/127.0.0.1:PORT"] },
  scouting: { multicast: { enabled: false }, gossip: { enabled: false } },
  transport: { link: { tls: {
    enable_mtls: true,                              // clients need a certificate of our authority, too
    root_ca_certificate: "FOLDER/ca.pem",
    listen_certificate: "FOLDER/robot.pem",
    listen_private_key: "FOLDER/robot.key",
  } } },
  access_control: {
    enabled: true,
    default_permission: "deny",
    rules: [
      { id: "give events", permission: "allow", flows: ["ingress"],
        messages: ["put", "liveliness_token"], key_exprs: ["robot/*/events", "robot/*/events/@events/*"] },
      { id: "be asked for events", permission: "allow", flows: ["egress"],
        messages: ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"],
        key_exprs: ["robot/*/events", "robot/*/label", "robot/*/events/@events/*"] },
      { id: "ask for results", permission: "allow", flows: ["ingress"],
        messages: ["declare_subscriber"], key_exprs: ["robot/*/features", "robot/*/prediction"] },
      { id: "get results", permission: "allow", flows: ["egress"],
        messages: ["put"], key_exprs: ["robot/*/features", "robot/*/prediction"] },
    ],
    subjects: [
      { id: "camera", cert_common_names: ["camera"] },
      { id: "operator", cert_common_names: ["operator"] },
    ],
    policies: [
      { rules: ["give events", "be asked for events"], subjects: ["camera"] },
      { rules: ["ask for results", "get results"], subjects: ["operator"] },
    ],
  },
}"""
"""The example of `streamfeat/live/README.md`."""


class Authority:
    """A certificate authority that lives in a folder."""

    def __init__(self, folder, name="ca"):
        self.folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        basic = x509.BasicConstraints(ca=True, path_length=0)
        self._write(name, self._key, self._sign(self._name, self._key, basic))

    def issue(self, name):
        """Write `name.pem` and `name.key`, for 127.0.0.1."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        address = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
        self._write(name, key, self._sign(subject, key, address))

    def _sign(self, subject, key, extension):
        now = datetime.datetime.now(datetime.UTC)
        builder = x509.CertificateBuilder(self._name, subject, key.public_key(), x509.random_serial_number())
        builder = builder.not_valid_before(now - datetime.timedelta(hours=1))
        builder = builder.not_valid_after(now + datetime.timedelta(hours=1))
        return builder.add_extension(extension, critical=False).sign(self._key, hashes.SHA256())

    def _write(self, name, key, certificate):
        (self.folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        (self.folder / f"{name}.key").write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM,
                serialization.PrivateFormat.PKCS8,
                serialization.NoEncryption(),
            )
        )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Certificates of one authority, and those of another."""
    folder = tmp_path_factory.mktemp("certificates")
    authority = Authority(folder)
    for name in ("robot", "camera", "operator", "stranger"):
        authority.issue(name)
    (folder / "other").mkdir()
    Authority(folder / "other").issue("camera")
    MODEL.save(folder / "model")
    return compiled(folder)


def client(port, folder, name, authority=None, *, timeout_s=60):
    """The configuration of somebody who connects, as a file."""
    config = {
        "mode": "client",
        "connect": {
            "endpoints": [f"tls/127.0.0.1:{port}"],
            "timeout_ms": 1000 * timeout_s,
            "exit_on_failure": True,
            "retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "scouting": {"multicast": {"enabled": False}},
        "transport": {
            "link": {
                "tls": {
                    "root_ca_certificate": str((authority or folder) / "ca.pem"),
                    "enable_mtls": True,
                    "connect_certificate": str(folder / f"{name}.pem"),
                    "connect_private_key": str(folder / f"{name}.key"),
                }
            }
        },
    }
    path = folder / f"{name}.json5"
    path.write_text(json.dumps(config))
    return path


def test_certificates_and_access_control(folder):
    port = free_port()
    config = folder / "robot.json5"
    config.write_text(RULES.replace("PORT", str(port)).replace("FOLDER", str(folder)))
    job = ListenJob(
        PlainNames("robot/*/events"),
        folder / "model",
        emit="10ms",
        network=Network(config),
        silence_s=1e9,
        patience_s=1e9,
        max_delay_s=1e9,
    )
    key = "robot/cam0/events"
    with running(job):
        with (
            open_session(client(port, folder, "camera")) as camera,
            open_session(client(port, folder, "operator")) as operator,
            # Of the right authority, but with no right to anything.
            open_session(client(port, folder, "stranger")) as stranger,
            camera.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK) as source,
        ):
            overheard, read = Collector(stranger, "robot/**"), Collector(operator, "robot/*/features")
            for i in range(5):
                stranger.put(key, message(tiny.stream([5]), i), attachment=attachment(i + 1, b"s" * 16))
                operator.put(key, message(tiny.stream([5]), i), attachment=attachment(i + 1, b"o" * 16))
            until(lambda: source.matching_status.matching)
            sent = itertools.count()

            def put():
                i = next(sent)
                batch = tiny.steady(i * 10_000, (i + 1) * 10_000, 50, seed=i)
                source.put(message(batch, i), attachment=attachment(i + 1, b"c" * 16))

            def heard():
                put()
                return read.samples

            # The robot learns of the operator's wish when it does.
            until(heard, "the operator's features")
            before = len(read.samples)
            for _ in range(20):
                put()
            until(lambda: len(read.samples) >= before + 20, "twenty features more")
            n_sent = next(sent)
            until(lambda: job.result()["packets"] == n_sent)
            assert overheard.samples == []
        # Of another authority: refused at the handshake, and the other way round it does not trust us.
        with pytest.raises(Exception, match="zenoh cannot use this configuration"):
            open_session(client(port, folder / "other", "camera", folder, timeout_s=1))
        with pytest.raises(Exception, match="zenoh cannot use this configuration"):
            open_session(client(port, folder / "other", "camera", timeout_s=1))
    result = job.result()
    assert (result["events"], result["foreign"], result["lost"], result["warnings"]) == (
        50 * n_sent,
        0,
        0,
        {},
    )
